"""Bode plot, margins and sensitivity of a controller's loop: ``python -m studies.bode my.py:SlowPID``."""
