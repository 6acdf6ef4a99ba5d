"""Learning curves as a picture."""

from __future__ import annotations

import io
from pathlib import Path

from lodbench.storage import write_bytes


def write_curves(history: list[dict[str, float]], path: Path) -> None:
    """Writes loss and learning rate per epoch above, the IoUs on validation views below, as PNG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 6.0), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    epochs = [row["epoch"] for row in history]
    above.plot(epochs, [row["loss"] for row in history], "o-", ms=3, color="#1b6ca8")
    above.set(ylabel="training loss", ylim=(0, None))
    rate = above.twinx()
    rate.plot(epochs, [row["lr"] for row in history], "--", color="#999999")
    rate.set_ylabel("learning rate (dashed)", color="#777777")
    validated = [row for row in history if "mean_iou" in row]
    for key, label, colour in (("mean_iou", "mean per view", "#c8553d"), ("pooled_iou", "pooled", "#588157")):
        below.plot(
            [row["epoch"] for row in validated],
            [row[key] for row in validated],
            "o-",
            ms=3,
            label=label,
            color=colour,
        )
    below.set(xlabel="epoch", ylabel="validation IoU")
    below.grid(alpha=0.3)
    below.legend()
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=110, metadata={"Software": None})
    write_bytes(path, content.getvalue())
