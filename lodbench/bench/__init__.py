"""Figures anyone can make again: accuracy on a real model, and speed beside other programs."""

from lodbench.bench.accuracy import measure_accuracy
from lodbench.bench.accuracy_options import AREAS, AccuracyOptions
from lodbench.bench.accuracy_report import AccuracyReport
from lodbench.bench.budget import BudgetReport, measure_budget
from lodbench.bench.city import CityBench, CityOptions, measure_city
from lodbench.bench.evaluation import EvaluationOptions, EvaluationReport, measure_evaluation
from lodbench.bench.figures import Figure
from lodbench.bench.iou_recall import IouRecallOptions, IouRecallReport, measure_iou_recall
from lodbench.bench.mask_quality import MaskQualityOptions, measure_masks
from lodbench.bench.mask_quality_report import MaskQualityReport
from lodbench.bench.scale import ScaleOptions, measure_scale
from lodbench.bench.scale_report import ScaleReport
from lodbench.bench.silhouette_report import SilhouetteReport
from lodbench.bench.silhouettes import SilhouetteOptions, measure_silhouettes
from lodbench.bench.training_data import (
    TrainingDataOptions,
    TrainingDataReport,
    measure_training_data,
)
from lodbench.bench.wide_priors import WidePriorReport, measure_wide_priors

__all__ = [
    "AREAS",
    "AccuracyOptions",
    "AccuracyReport",
    "BudgetReport",
    "CityBench",
    "CityOptions",
    "EvaluationOptions",
    "EvaluationReport",
    "Figure",
    "IouRecallOptions",
    "IouRecallReport",
    "MaskQualityOptions",
    "MaskQualityReport",
    "ScaleOptions",
    "ScaleReport",
    "SilhouetteOptions",
    "SilhouetteReport",
    "TrainingDataOptions",
    "TrainingDataReport",
    "WidePriorReport",
    "measure_accuracy",
    "measure_budget",
    "measure_city",
    "measure_evaluation",
    "measure_iou_recall",
    "measure_masks",
    "measure_scale",
    "measure_silhouettes",
    "measure_training_data",
    "measure_wide_priors",
]
