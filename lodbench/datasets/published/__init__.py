"""Published datasets, read from wherever a person put the download.

``layout`` says what a spec holds. Specs of LoD-Loc's papers are in ``lodloc``, which reads the two trees that
these come in; others are beside a reader of their own over ``own_layout``.
"""
