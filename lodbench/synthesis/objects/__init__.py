"""What stands in pictures: triangles with classes and colours, their builder, shapes of trees and cars."""
