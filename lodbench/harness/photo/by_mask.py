"""Where a photo's own pixels do not tell its pose: what the mask of a network says."""

from __future__ import annotations

from dataclasses import replace

from lodbench.citymodel.scene import Scene
from lodbench.errors import QueryFault
from lodbench.evaluation import pose_error
from lodbench.geometry import Pose
from lodbench.harness.photo.prepare import PreparedPhoto, pinhole_mask
from lodbench.methods import Estimate
from lodbench.methods.localize import localize
from lodbench.reporting.answers import TRUSTED_PROBABILITY

# Two answers within 2 m and 2 degrees of the truth are no farther from each other than this.
_TOGETHER_M, _TOGETHER_DEG = 4.0, 4.0
# What a mask's probability is worth where the pixels say another place (docs/adr/0059).
_ALONE = 0.5


def more_probable(
    photo: PreparedPhoto, scene: Scene, prior: Pose, estimate: Estimate
) -> tuple[PreparedPhoto, Estimate]:
    """Returns an answer, or another one by a mask where that is more probable, and the photo with its mask.

    Args:
        photo: Its request says by which method, and who makes the mask; if it names no such method, or the
            answer is to be trusted, nothing is made.
        scene: The map.
        prior: In the city's coordinates.
        estimate: The answer without a mask, in them, too.

    Raises:
        ConfigError: The segmenter's weights are missing or no network.
    """
    request, by_pixels = photo.request, estimate.probability or 0.0
    if request.by_mask is None or by_pixels >= TRUSTED_PROBABILITY:
        return photo, estimate
    try:
        mask = pinhole_mask(request, photo.camera, photo.pinhole)
        found = localize(
            scene,
            photo.pinhole,
            prior,
            mask,
            method=request.by_mask,
            seed=request.seed,
            lens_percent=photo.lens_percent,
            camera_sigmas=photo.camera_sigmas,
        )
    except QueryFault as fault:
        note = f"a network's mask was tried as well, without result: {fault.message.rstrip('.')}"
        return photo, replace(estimate, notes=(*estimate.notes, note))
    apart = pose_error(found.pose, estimate.pose)
    agree = apart.translation_m <= _TOGETHER_M and apart.rotation_deg <= _TOGETHER_DEG
    probability = (found.probability or 0.0) * (1.0 if agree else _ALONE)
    if probability <= by_pixels:
        return photo, estimate
    maker = "a segmenter" if request.segmenter is None else request.segmenter.name
    note = (
        f"this pose is from the mask that {maker} made (method {request.by_mask.name}); the pose from the "
        f"photo's own pixels had a probability of {100.0 * by_pixels:.0f} %"
    )
    answer = replace(
        found,
        probability=probability,
        notes=(*found.notes, note),
        alternatives=(estimate.pose, *found.alternatives),
        alternative_probabilities=(by_pixels, *found.alternative_probabilities),
    )
    return replace(photo, mask=mask), answer
