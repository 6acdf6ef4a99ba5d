"""Methods in another environment: a process of another Python answers over pipes, by the same protocol."""
