"""Photos and what they state of themselves: below datasets, which are made of them.

==============  ====================================================================================
``pictures``    pixels from files and to them
``files``       which files are photos, which were taken on one flight, which have traced masks
``metadata``    what a photo, or a video's subtitles, state: EXIF (``tags``) and XMP (``xmp``)
``camera``      from metadata to a camera; ``focal``: to its focal length
``pose``        from metadata to a rough pose in a city's coordinates (``map_frame``); ``notes`` on both
``undistort``   photos and masks of a real lens as a pinhole would have taken them
==============  ====================================================================================
"""
