"""CityJSON and CityJSONSeq, read and written."""
