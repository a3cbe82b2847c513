"""How well one lens must stand for another."""

LIMIT = 0.05  # px, anywhere in the image, that another lens model may be off
