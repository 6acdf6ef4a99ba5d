"""How well a network segments views: whole pictures at its working size."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import nn

from lodbench.segmentation.nets.working import Padding
from lodbench.training.nets.batches import as_floats, as_tensors
from lodbench.training.samples import LEAST_SHARE, Sample


@torch.no_grad()
def validation_iou(
    net: nn.Module,
    samples: list[Sample],
    size: int,
    square: bool,
    stride: int,
    device: torch.device,
    advance: Callable[[], None] = lambda: None,
) -> dict[str, float]:
    """Returns the mean IoU per view and that of all pixels pooled, over views with 5 % buildings or more.

    A network is left in the mode, training or not, that it came in.
    """
    was_training = net.training
    net.eval()
    shared_counts, union_counts = [], []
    for sample in samples:
        photo, mask = sample.read(size, square)
        images, truth = as_tensors([as_floats(photo)], [mask])
        logits = Padding(net, stride)(images.to(device))[0].float().cpu()
        found, wanted = logits >= 0, truth >= 0.5
        if wanted.float().mean() >= LEAST_SHARE:
            shared_counts.append(int((found & wanted).sum()))
            union_counts.append(int((found | wanted).sum()))
        advance()
    net.train(was_training)
    if not union_counts:
        return {"mean_iou": float("nan"), "pooled_iou": float("nan"), "views": 0}
    shared, union = np.array(shared_counts), np.array(union_counts)
    return {
        "mean_iou": float((shared / union).mean()),
        "pooled_iou": float(shared.sum() / union.sum()),
        "views": len(union),
    }
