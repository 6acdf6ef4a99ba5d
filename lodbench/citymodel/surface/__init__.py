"""Surface models as cities: heights on a grid, the ground below them, and what rises above it."""

from lodbench.citymodel.formats import Surface as Surface
