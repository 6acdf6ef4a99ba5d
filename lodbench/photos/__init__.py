"""Photos and what they state of themselves: below datasets, which are made of them.

==============  ====================================================================================
``pictures``    pixels from files and to them
``files``       which files are photos, which were taken on one flight, which have traced masks
``metadata``    what a photo, or a video's subtitles, state: EXIF (``tags``) and XMP (``xmp``)
``camera``      from metadata to a camera, and its photos as a pinhole would have taken them; ``focal``
``pose``        from metadata to a rough pose in a city's coordinates (``map_frame``)
``measurements``  what is measured beside a photo, and notes on places and heights
==============  ====================================================================================
"""
