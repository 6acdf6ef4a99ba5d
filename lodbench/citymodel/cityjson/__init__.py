"""CityJSON and CityJSONSeq, read and written."""

from lodbench.citymodel.formats import CityJson as CityJson
