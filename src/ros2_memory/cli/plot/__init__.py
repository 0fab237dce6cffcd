"""`ros2-memory plot`: pictures of what is recorded, as SVG, PNG or PDF."""
