"""Surface models as cities: heights on a grid, the ground below them, and what rises above it."""
