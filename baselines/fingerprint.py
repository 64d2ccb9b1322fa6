"""What a controller's results depend on, as one hash: its settings and the modules it is written in."""

from __future__ import annotations

import hashlib
from pathlib import Path


def fingerprint(settings: object, *modules: str) -> str:
    """SHA-256 of settings that print themselves in full, and of modules of this package (16 hex digits)."""
    digest = hashlib.sha256(repr(settings).encode())
    for module in modules:
        digest.update(Path(__file__).with_name(f"{module}.py").read_bytes())
    return digest.hexdigest()[:16]
