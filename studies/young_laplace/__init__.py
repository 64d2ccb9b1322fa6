"""The polynomials of the exact meniscus: ``python -m studies.young_laplace``."""
