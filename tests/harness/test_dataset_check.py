"""What a dataset's check says of its priors."""

from types import SimpleNamespace

from lodbench.geometry import EulerAngles, Pose
from lodbench.harness.dataset_check import prior_errors_in_words

POSE = Pose.from_euler(EulerAngles(30.0, 0.0, 0.0), (1.0, 2.0, 3.0))


def test_errors_of_priors_without_a_truth_are_not_known():
    entries = [
        SimpleNamespace(split=name, key=name, prior=prior) for name, prior in (("a", POSE), ("b", None))
    ]
    dataset = SimpleNamespace(splits=("a", "b"), entries=entries, truth={})
    assert prior_errors_in_words(dataset) == {"a": "errors not known, for there is no truth", "b": "no prior"}
    dataset.truth = {"a": POSE.shifted((3.0, 4.0, 0.0))}
    assert prior_errors_in_words(dataset)["a"] == "median 5.00 m / 0.00 deg"
