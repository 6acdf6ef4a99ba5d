"""Figures anyone can make again: accuracy on a real model, and speed beside other programs."""

from lodbench.bench.accuracy import AccuracyOptions, measure_accuracy
from lodbench.bench.accuracy_report import AccuracyReport
from lodbench.bench.budget import BudgetReport, measure_budget
from lodbench.bench.city import CityBench, CityOptions, measure_city
from lodbench.bench.evaluation import EvaluationOptions, EvaluationReport, measure_evaluation
from lodbench.bench.figures import Figure
from lodbench.bench.scale import ScaleOptions, measure_scale
from lodbench.bench.scale_report import ScaleReport
from lodbench.bench.segmentation import SegmentationOptions, SegmentationReport, measure_segmentation
from lodbench.bench.silhouette_report import SilhouetteReport
from lodbench.bench.silhouettes import SilhouetteOptions, measure_silhouettes
from lodbench.bench.training_data import (
    TrainingDataOptions,
    TrainingDataReport,
    measure_training_data,
)

__all__ = [
    "AccuracyOptions",
    "AccuracyReport",
    "BudgetReport",
    "CityBench",
    "CityOptions",
    "EvaluationOptions",
    "EvaluationReport",
    "Figure",
    "ScaleOptions",
    "ScaleReport",
    "SegmentationOptions",
    "SegmentationReport",
    "SilhouetteOptions",
    "SilhouetteReport",
    "TrainingDataOptions",
    "TrainingDataReport",
    "measure_accuracy",
    "measure_budget",
    "measure_city",
    "measure_evaluation",
    "measure_scale",
    "measure_segmentation",
    "measure_silhouettes",
    "measure_training_data",
]
