"""Result documents, their JSON Schemas, and reading and writing them."""
