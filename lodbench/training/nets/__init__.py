"""Training in torch: the modules here import it at the top; others import them late."""
