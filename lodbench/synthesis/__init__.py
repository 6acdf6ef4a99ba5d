"""Drawn data: a town, what surrounds any city, photos, views, and masks as wrong as a network's.

=====================  ===========================================================================
module                 what it makes
=====================  ===========================================================================
``town``               the demo town: streets, blocks, buildings in three levels of detail, CityGML
``surroundings``       trees, cars and clutter beside a city model that has none, on the ground and
                       land cover of ``land_cover``
``surveys``            the demo town years before, as a textured map, a surface model, an orthophoto
``objects``            what stands in pictures: classes of surfaces, mesh builder, trees, cars
``photo``              pictures of all that: looks, surfaces, sun, camera response, render scene
``views``              seeded drone views that show enough buildings, and drawn photos of them
``camera_paths``       settings of training pictures; where their cameras and those of flights are put
``flights``            ``dataset=flights``: flights over any city, with errors of drone and map
``mask_degradation``   masks as wrong as a network's, of single buildings too
``demo``               ``dataset=demo`` and ``demo_train``, with what they have on demand
``views_dataset``      ``dataset=views``: seeded views of any city, what map and camera are wrong about
``generate``           ``generate-training-data``: files, manifest, sheet of the ``plan_views``
=====================  ===========================================================================

Where something new goes:

- a roof shape: a function and a line in ``ROOF_SHAPES`` of ``town/roofs.py``, and who builds it: houses in
  ``town/buildings.py``, all that stands alone in ``town/houses.py``;
- a kind of block or landmark: a function in ``town/houses.py``, chosen in ``town/town.py``;
- a camera path: a function and a line in ``CAMERA_PATHS`` of ``camera_paths.py`` (training pictures) or in
  ``FLIGHT_PATHS`` beside it (flights); its name and settings in ``GenerateParams`` there and
  ``conf/generate-training-data.yaml``;
- a look of pictures (sun, air, season, sensor): a file in ``conf/training``; a new kind of change is a
  field of ``LookRanges`` in ``photo.py``, used there if the sensor makes it and in ``kernels/surfaces.py`` if
  the place does;
- a thing that stands there: its shape in ``objects.py``, its places in ``surroundings.py`` or
  ``town/props.py``;
- something that networks take for a building and is none: a function and a line in ``CLUTTER`` of
  ``surroundings.py``; a colour of roofs or walls: the palettes of ``photo.py``;
- an error of masks: a field of ``_Errors``, used in ``mask_degradation.py``.
"""
