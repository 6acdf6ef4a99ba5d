"""What stands around a city model's buildings: land cover, relief, trees and cars."""
