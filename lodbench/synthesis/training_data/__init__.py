"""Pictures, masks and poses to train on, of any city."""
