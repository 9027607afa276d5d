"""The run folder: records, parts, tables, provenance, and reading them back."""
