"""Tables, figures, pages and the leaderboard: results as people read them, from plain data.

==================  ============================================================================
what                where
==================  ============================================================================
tables of recalls   ``tables`` (lines), ``table_columns`` (what is shown), ``table_formats``
text of a terminal  ``aligned_text``, ``answers``, ``flight_words``, ``safe_text``
figures             ``figures``, ``run_figures``, ``basin_figures``, ``calibration_figures``, ``map_figure``
pages               ``page`` over ``templates``; ``comparison``, ``flight_page``, ``leaderboard``, ``view3d``
overlays of photos  ``overlays``
==================  ============================================================================

Pages of what must be opened first (runs, photos, cities) are filled in ``lodbench.harness``.
"""
