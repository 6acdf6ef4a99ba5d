"""The demo: a made-up town, its queries, and the folder they are written to."""
