"""Datasets: folders, published layouts, priors, cards, and poses in the formats of other programs.

======================  ============================================================================
what                    where
======================  ============================================================================
what a query is         ``query``, ``inputs`` (what methods may require)
``dataset=folder``      ``folder``; from photos: ``own``, ``photo_*``, ``undistort``
published datasets      ``published``, their cards in ``data_cards``; downloads in ``download``
priors                  ``priors`` (their errors), ``prior_sources`` (where they come from)
pose files              ``pose_text`` (LoD-Loc's), ``exchange`` (others'), ``pose_files`` (which it is)
photos                  ``pictures``, ``picture_faults``; posed ones of the place: ``references``
======================  ============================================================================

Made-up datasets are in ``lodbench.synthesis``.
"""
