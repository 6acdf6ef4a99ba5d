"""Networks in torch: the one folder whose modules import it at the top; others import them late."""
