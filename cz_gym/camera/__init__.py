"""The camera above the melt: its view, ray-traced images, and the detector of the bright ring in them."""

from .image import RingDetector
from .view import Camera

__all__ = ["Camera", "RingDetector"]
