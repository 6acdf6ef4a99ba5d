"""Videos and folders of photos, tracked over a city."""
