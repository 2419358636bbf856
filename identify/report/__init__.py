"""Reports of results: one self-contained HTML file each, and the glossary."""
