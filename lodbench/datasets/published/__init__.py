"""The four datasets of the LoD-Loc papers, read from wherever a person put the download."""
