"""Does a plug-in conform to the protocol of its kind? Assessed rule by rule, on a scene of a few blocks."""
