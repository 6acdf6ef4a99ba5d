"""Made-up data: towns, what surrounds a city, photos of them, views, and masks as wrong as a network's."""
