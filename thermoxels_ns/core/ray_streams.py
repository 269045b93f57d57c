"""Which photographs a ray belongs to: RGB, thermal, or both."""

# A batch is one `RayBundle` whose ``metadata["stream"]`` holds these bits per ray, shape (n, 1), uint8.
RGB_STREAM = 1  # The ray carries a colour target
THERMAL_STREAM = 2  # The ray carries a temperature target
