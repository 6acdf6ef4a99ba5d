"""The names that others rely on: a change here is a change of the interface, and of CHANGELOG.md."""

import tomllib
from inspect import signature
from pathlib import Path

import lodbench
from lodbench.cli.parser import COMMANDS

ROOT = Path(__file__).resolve().parents[1]
PUBLIC = """
    __version__ Camera EulerAngles LodLocV2 LodbenchError Pose QueryFault Scene compare leaderboard load_run
    localize localize_flight localize_photo locate make_renderer open_scene pose_error read_mask read_poses
    run_method
""".split()
PLUG_INS = {
    "lodbench.methods": """
        auto lodlocv2 contour_alignment flight georeference region tracking prior_only uavd4l cadloc lodloc
        mcloc lodlocv3
    """.split(),
    "lodbench.datasets": """
        folder demo views flights uavd4l_lod uavd4l_lodv2 swiss_epfl swiss_epflv2 tokyo_lodv3 uavd4l
        egeniouss ortholoc anyvisloc semcitylocked demo_train real_flights
    """.split(),
    "lodbench.segmenters": """
        none masks instances map_instances compact compact_instances compact_classes classes efficient_unet
        map_guided oracle noisy_oracle sam2_unet sam1_adapter semantic fastsam
    """.split(),
    "lodbench.renderers": ["silhouette", "reference", "raster", "pyrender", "open3d"],
    "lodbench.fits": ["iou", "soft_iou", "confident_iou", "boundary", "semantic_iou", "region"],
    "lodbench.priors": ["file", "sensor", "uniform", "basin"],
    "lodbench.pose_formats": "lines c2w colmap tum kapture nerfstudio metashape pix4d odm table".split(),
    "lodbench.export_formats": """
        colmap kapture nerfstudio tum visuallocalization metashape pix4d odm geojson gpkg csv queries
        parquet rerun submission
    """.split(),
    "lodbench.city_readers": ["citygml", "cityjson", "obj", "mesh", "footprints", "surface"],
    "lodbench.feature_extractors": ["sift", "xfeat"],
    "lodbench.matchers": """
        mutual_nn sift_nn xfeat xfeat_lighterglue superpoint_superglue superpoint_lightglue disk_lightglue
        eloftr matchanything loftr roma
    """.split(),
    "lodbench.retrievals": ["hog", "xfeat", "dinov2"],
    "lodbench.pose_solvers": ["opencv", "poselib", "pycolmap", "upright"],
    "lodbench.metrics": ["error_parts", "mask_iou", "calibration"],
    "lodbench.config_sources": ["lodbench"],
}
ARGUMENTS = {
    "compare": ["runs", "thresholds"],
    "leaderboard": ["dataset", "root"],
    "load_run": ["folder"],
    "localize": """
        scene camera prior mask image method seed threads lens_percent camera_sigmas measured segment
    """.split(),
    "localize_flight": ["photos", "city", "options"],
    "localize_photo": ["photo", "city", "options"],
    "locate": """
        scene camera pose pixel covariance parameters pixel_sigma_px map_sigma_m ground_sigma_m laser
    """.split(),
    "make_renderer": ["name", "scene", "threads"],
    "open_scene": ["path", "lod", "crs", "options", "roof_height"],
    "pose_error": ["estimate", "truth"],
    "read_mask": ["path"],
    "read_poses": ["path"],
    "run_method": ["method", "dataset", "city", "segmenter", "runs", "tilt", "seed", "limit"],
}
COMMAND_NAMES = """
    localize locate track georeference mask trace run basin evaluate compare report export status verify
    leaderboard bench city dataset render generate-training-data train doctor check-method check-plugin
    completion
""".split()


def test_public_names():
    assert lodbench.__all__ == PUBLIC


def test_plug_ins_of_this_package():
    groups = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]
    assert {group: list(names) for group, names in groups.items()} == PLUG_INS


def test_commands():
    assert list(COMMANDS) == COMMAND_NAMES


def test_arguments_of_public_functions():
    # Callers use places and names: only additions with defaults leave them right.
    assert {name: list(signature(getattr(lodbench, name)).parameters) for name in ARGUMENTS} == ARGUMENTS
