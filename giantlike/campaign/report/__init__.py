"""The report of a run: figures and HTML pages."""
