"""The four datasets of the LoD-Loc papers, read from wherever a person put the download.

A module of facts each (``spec`` says which), over readers of the two layouts they come in. A dataset in
another layout is a module of ``lodbench/datasets``.
"""
