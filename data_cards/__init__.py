"""Cards of datasets and sources: Markdown with a YAML head."""
