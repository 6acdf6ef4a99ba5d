"""What a hypothesis costs in a city of a million buildings, beside the same views of its core alone."""

import sys

from experiments.command import run
from experiments.scale.measure import ScaleOptions, measure_scale

sys.exit(run("scale", ScaleOptions, measure_scale))
