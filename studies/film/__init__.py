"""The README's animated picture: ``python -m studies.film``."""
