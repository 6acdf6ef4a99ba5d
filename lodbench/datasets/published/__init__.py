"""Published datasets, read from wherever a person put the download.

A module of facts each (``spec`` says which): those of the LoD-Loc papers over readers of the two layouts they
come in, others with a reader of their own over ``own_layout``.
"""
