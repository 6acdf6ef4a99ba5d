"""All code that numba compiles, and nothing that calls it: no module here imports another part of lodbench.

``compiled`` has the decorators, ``cache`` the place of what they made. ``arguments`` and ``looks`` say what
kernels are given, ``raster_rule`` what they mean by a covered pixel; these three load without numba.
"""
