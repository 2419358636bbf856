"""Writes the schema files: ``python -m armident.identify.documents``."""

from armident.identify.documents.schemas import write_schemas

if __name__ == "__main__":
    write_schemas()
