"""Datasets: folders, published layouts, priors, cards, and poses in the formats of other programs.

======================  ============================================================================
what                    where
======================  ============================================================================
what a query is         ``query``, ``inputs`` (what methods may require, and labels)
``dataset=folder``      ``folder``; from photos: ``own``
published datasets      ``published``: by name, with cards and downloads, in its ``catalogue``
priors                  ``prior_sources``: where they come from, errors of drawn ones
pose files              ``pose_text`` (LoD-Loc's), ``exchange`` (others'), ``pose_files`` (which it is)
what is wrong           ``faults``: codes of findings; cameras, photos, masks that do not fit
======================  ============================================================================

Made-up datasets are in ``lodbench.synthesis``.
"""
