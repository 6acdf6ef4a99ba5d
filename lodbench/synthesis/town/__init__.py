"""A made-up town: its streets, buildings, relief and planting, written as CityGML.

From the ground up:

- the land: ``streets`` (blocks, streets, terrain; who stands where), ``shapes`` (plane and solid geometry);
- what is built on a block: ``houses`` (also flats, works and landmarks);
- a building: ``roofs`` (the shapes), and ``buildings``, which adds annexes, dormers, chimneys and openings at
  three levels of detail;
- the whole: ``town``, which says what goes into which district, and its ground;
- what a photo shows: ``props``;
- the dataset: ``build`` writes it (views, priors, masks, photos), CityGML by ``templates``.
"""
