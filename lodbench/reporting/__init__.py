"""Tables, figures, pages and the leaderboard: results as people read them, from plain data.

==================  ============================================================================
what                where
==================  ============================================================================
tables of recalls   ``tables``; ``table_heads`` (what is shown, what rows are called)
text of a terminal  ``aligned_text``, ``answers``, ``flight_words``
figures             ``figures``, ``maps``
pages               ``page`` over ``templates``; ``flight_words``, ``leaderboard``, ``maps``
overlays of photos  ``overlays``
==================  ============================================================================

Pages of what must be opened first (runs, photos, cities) are filled in ``lodbench.harness``.
"""
