"""Datasets: folders, published layouts, priors, cards, and poses in the formats of other programs.

======================  ============================================================================
what                    where
======================  ============================================================================
what a query is         ``query``, ``inputs`` (what methods may require)
``dataset=folder``      ``folder``; from photos: ``own``
published datasets      ``published``, their cards in ``data_cards``; downloads in ``download``
priors                  ``priors`` (their errors), ``prior_sources`` (where they come from)
pose files              ``pose_text`` (LoD-Loc's), ``exchange`` (others'), ``pose_files`` (which it is)
photos                  ``faults``; posed ones of the place: ``references``; see ``lodbench.photos``
======================  ============================================================================

Made-up datasets are in ``lodbench.synthesis``.
"""
