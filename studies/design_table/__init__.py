"""Margins and noise gains of the linear controllers: ``python -m studies.design_table``."""
