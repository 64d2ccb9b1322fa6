"""Colours of the pictures: Okabe and Ito's where a colour has a meaning, safe for colour-blind readers."""

Colour = tuple[int, int, int]

BACK: Colour = (13, 17, 23)
PANEL: Colour = (22, 27, 36)
RIM: Colour = (56, 66, 82)
INK: Colour = (236, 239, 244)
FAINT: Colour = (150, 160, 176)
BAND: Colour = (38, 50, 62)

TRUE: Colour = (86, 180, 233)
"""The true crystal."""
CAMERA: Colour = (240, 228, 66)
"""The bright ring, and the radius that the camera reads from it."""
NOISE: Colour = (142, 138, 52)
"""The camera's line in the chart, dim since its noise fills an area."""
REFERENCE: Colour = (255, 255, 255)
DRIVE: Colour = (204, 121, 167)
"""Pull speed and heater."""
TEMPERATURE: Colour = (230, 159, 0)
WELL: Colour = (0, 190, 140)
ALARM: Colour = (213, 94, 0)

GAS: Colour = (15, 19, 27)
MELT: Colour = (242, 138, 66)
ON_MELT: Colour = (60, 20, 0)
"""Words on the bright melt."""
CRYSTAL: Colour = (104, 112, 128)
