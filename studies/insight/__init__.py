"""What an agent does that other controllers do not: ``python -m studies.insight``."""
