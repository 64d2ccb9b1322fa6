"""What a step costs, beside other environments: ``python -m studies.speed``."""
