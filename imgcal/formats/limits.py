"""How well one lens must stand for another."""

HELD_DISTORTION = 1e-6  # spread of coefficients that are to stay as they are: no image shows it
LIMIT = 0.05  # px, anywhere in the image, that another lens model may be off
ROUNDING = 1e-3  # px that the digits of a file may cost: a hundredth of how well markers are measured
