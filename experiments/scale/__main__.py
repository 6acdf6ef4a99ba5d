"""What a hypothesis costs in a city of a million buildings, beside the same views of its core alone."""

import sys

from experiments.command import run_options
from experiments.scale.measure import ScaleOptions, measure_scale

sys.exit(run_options("scale", ScaleOptions, measure_scale))
