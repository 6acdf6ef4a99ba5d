"""Made-up data: a town, what is around any city, photos, views, and masks as wrong as a network's.

=====================  ===========================================================================
room                   what it makes
=====================  ===========================================================================
``town``               the demo town: streets, blocks, buildings in three levels of detail, CityGML
``surroundings``       ground, land cover, trees, cars, clutter around a city model that has none
``survey``             the demo town years before: textured map, made when a method asks for it
``objects``            what stands in pictures: classes of surfaces, mesh builder, trees, cars
``photo``              pictures of all that: looks, surfaces, sun, camera response, render scene
``view_sampling``      seeded drone views that show enough buildings; the check that judges them
``camera_paths``       where cameras of training pictures and of flights are put
``flights``            ``dataset=flights``: flights over any city, with errors of drone and map
``mask_degradation``   masks as wrong as a network's, by ``mask_error_fields``; of single buildings:
                       ``instance_degradation``
``queries``            made-up queries, and the one way they become a folder
``demo``               ``dataset=demo`` and ``demo_train``, with what they have on demand
``views_dataset``      ``dataset=views``: seeded views of any city, what map and camera are wrong about; their
                       photos are in ``view_photos``
``training_data``      ``generate-training-data``: settings, plan of views, files, manifest, sheet
=====================  ===========================================================================

Where something new goes:

- a roof shape: a function and a line in ``ROOF_SHAPES`` of ``town/roofs.py``, and who builds it: houses in
  ``town/fittings.py``, all that stands alone in ``town/landmarks.py``;
- a kind of block or landmark: a function in ``town/landmarks.py``, chosen in ``town/town.py``;
- a camera path: a function and a line in ``CAMERA_PATHS`` of ``camera_paths.py`` (training pictures) or in
  ``FLIGHT_PATHS`` beside it (flights); its name and settings in ``training_data/params.py`` and
  ``conf/generate-training-data.yaml``;
- a look of pictures (sun, air, season, sensor): a file in ``conf/training``; a new kind of change is a
  field of ``LookRanges`` in ``photo/look.py``, used in ``photo/renderer.py`` if the sensor makes
  it and in ``kernels/surfaces.py`` or ``kernels/patterns.py`` if the place does;
- a thing that stands around: its shape in ``objects``, its places in ``surroundings/surroundings.py``
  or ``town/trees_and_cars.py``;
- something that networks take for a building and is none: a function and a line in ``CLUTTER`` of
  ``surroundings/clutter.py``; a colour of roofs or walls: the palettes of ``photo/shading.py``;
- an error of masks: a field in ``mask_error_fields.py``, used in ``mask_degradation.py``.
"""
