"""Methods that are not ours, each in a folder of its own, through the public plug-in interface only."""
