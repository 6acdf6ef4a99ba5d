"""A made-up town: its streets, buildings, relief and planting, written as CityGML.

From the ground up:

- the land: ``terrain`` (hills and a valley; who stands where), ``streets`` (blocks and streets), ``shapes``
  (plane geometry);
- what is built on a block: ``houses``, ``landmarks`` (also flats and works), ``site`` (whether one more plan
  fits);
- a building: ``extrusion`` (a roof's cross-section along a path), ``roofs`` (the shapes), ``fittings``
  (annexes, dormers, chimneys), ``openings``, ``solid`` (closed bodies), and ``building``, which
  puts them together at three levels of detail;
- the whole: ``town``, which says what goes into which district; its two ``looks``;
- what a photo shows: ``props``, ``ground``, ``trees_and_cars``;
- the dataset: ``queries`` (views, priors, masks, photos); ``build`` writes it, CityGML by ``templates``.
"""
