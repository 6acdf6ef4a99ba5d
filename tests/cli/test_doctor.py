"""`lodbench doctor`, `check-method` and `check-plugin`: what works, what conforms, and what does not."""

import json
from pathlib import Path

import pytest

from lodbench.cli import main
from lodbench.findings import Check
from lodbench.harness import doctor
from tests.site_packages import write_package


@pytest.mark.slow
def test_report_for_people(lodbench):
    done = lodbench("doctor", "--thorough")
    assert done.returncode == 0, done.stdout + done.stderr
    for word in ("Python", "numba", "numpy", "silhouette", "raster", "open3d", "pyrender"):
        assert word in done.stdout
    assert "The base install works." in done.stdout


def test_report_for_machines_and_a_broken_base(lodbench, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setattr("lodbench.harness.doctor.RENDERER_TRIALS", {"raster": True})
    monkeypatch.setattr("lodbench.harness.doctor.NETWORKS", ())
    done = lodbench("doctor", "--thorough", "--json", LODBENCH_CACHE=str(tmp_path / "file"))
    checks = {check["name"]: check for check in map(json.loads, done.stdout.splitlines())}
    assert done.returncode == 1
    assert (checks["cache"]["status"], checks["cache"]["is_base"]) == ("broken", True)
    assert "LODBENCH_CACHE" in checks["cache"]["hint"]
    assert checks["raster"]["status"] == "ok"
    assert set(checks["raster"]) == {"section", "name", "status", "detail", "hint", "is_base"}


def test_it_starts_where_numpy_does_not(lodbench_process, tmp_path):
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "numpy.py").write_text("raise ImportError('numpy is broken here')")
    done = lodbench_process("doctor", PYTHONPATH=str(tmp_path / "broken"))
    assert done.returncode == 1, done.stderr
    assert "The base install is broken" in done.stdout
    assert "numpy is broken here" in done.stdout


def test_without_thorough_it_says_what_is_there_and_tries_nothing(lodbench, monkeypatch):
    tried = []

    def run_probe(section, name, is_base, timeout_s):
        tried.append(name)
        return Check(section, name, "ok", "the compiled packages load", "", is_base)

    monkeypatch.setattr(doctor, "run_probe", run_probe)
    real = doctor.find_spec
    monkeypatch.setattr(doctor, "find_spec", lambda name: None if name == "pyrender" else real(name))
    monkeypatch.setattr(doctor, "NETWORKS", ("compact", "no_such_network"))
    done = lodbench("doctor", "--json")
    checks = {check["name"]: check for check in map(json.loads, done.stdout.splitlines())}
    assert tried == ["imports"]
    assert (checks["silhouette"]["status"], checks["silhouette"]["is_base"]) == ("ok", True)
    assert "--thorough" in checks["silhouette"]["detail"]
    assert (checks["pyrender"]["status"], checks["pyrender"]["is_base"]) == ("absent", False)
    assert checks["pyrender"]["hint"] == "pip install 'lodbench[render]'"
    assert checks["compact"]["status"] == "ok"
    assert (checks["no_such_network"]["status"], done.returncode) == ("broken", 1)


def test_it_says_that_nothing_was_tried(lodbench):
    done = lodbench("doctor")
    assert (done.returncode, "the compiled packages load" in done.stdout) == (0, True), done.stderr
    assert "The base install is complete; --thorough tries it." in done.stdout


MODULE = '''
import itertools
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lodbench.errors import QueryFault
from lodbench.geometry import EulerAngles, Pose
from lodbench.methods import Estimate

COUNTER = itertools.count()


def params(method, frozen=True):
    """Returns a dataclass with the method's name, and steps."""
    types = {"name": str, "steps": int}
    return dataclass(frozen=frozen)(
        type("Params", (), {"__annotations__": types, "name": method, "steps": 3})
    )


class Sound:
    """Moves the prior by a random step; faults where there is no building."""

    name = "sound"
    requires = frozenset({"mask"})
    params_type = params("sound")

    def __init__(self, settings):
        self.settings = settings
        self.calls = 0

    def localize(self, query, city_map, streams):
        if not query.building_probability.any():
            raise QueryFault("the mask holds no building")
        step = streams("step", 0).normal(size=3)
        city_map.render(query.camera, query.prior)
        return Estimate(query.prior.shifted(step), 0.5)


def variant(method, **functions):
    return type(method, (Sound,), {"name": method, "params_type": params(method), **functions})


def changed(**values):
    def localize(self, query, city_map, streams):
        estimate = Sound.localize(self, query, city_map, streams)
        return replace(estimate, **{key: v(query, estimate) for key, v in values.items()})

    return localize


def stateful(self, query, city_map, streams):
    self.calls += 1
    estimate = Sound.localize(self, query, city_map, streams)
    return replace(estimate, pose=estimate.pose.shifted([self.calls, 0, 0]))


def dreamy(self, query, city_map, streams):
    estimate = Sound.localize(self, query, city_map, streams)
    return replace(estimate, pose=estimate.pose.shifted([np.random.default_rng().normal(), 0, 0]))


def careless(self, query, city_map, streams):
    query.building_probability[:10] = 1.0
    return Sound.localize(self, query, city_map, streams)


def crashing(self, query, city_map, streams):
    if not query.building_probability.any():
        raise ZeroDivisionError("no pixels")
    return Sound.localize(self, query, city_map, streams)


def credulous(self, query, city_map, streams):
    step = streams("step", 0).normal(size=3) + query.building_probability.mean()
    return Estimate(query.prior.shifted(step), 0.5)


def speechless(self, query, city_map, streams):
    raise QueryFault("I never know")


def exploding(self, query, city_map, streams):
    raise KeyError("oh")


def mistaken(self, query, city_map, streams):
    return Estimate(query.pryor, 0.5)


def talking(self, query, city_map, streams):
    print("I am looking")
    return Sound.localize(self, query, city_map, streams)


Talking = variant("talking", localize=talking)
GLOBAL = np.array([281_000.0, 5_657_000.0, 60.0])
Stateful = variant("stateful", localize=stateful)
Counting = variant("counting", localize=changed(score=lambda q, e: float(next(COUNTER))))
Dreamy = variant("dreamy", localize=dreamy)
Careless = variant("careless", localize=careless)
Crashing = variant("crashing", localize=crashing)
Credulous = variant("credulous", localize=credulous)
Speechless = variant("speechless", localize=speechless)
Exploding = variant("exploding", localize=exploding)
Mistaken = variant("mistaken", localize=mistaken)
Wordless = variant("wordless", localize=lambda *_: None)
NoNumber = variant(
    "no_number", localize=changed(pose=lambda q, e: Pose(q.prior.rotation, np.full(3, np.nan)))
)
Sheared = variant("sheared", localize=changed(pose=lambda q, e: Pose(2 * q.prior.rotation, np.zeros(3))))
Abroad = variant("abroad", localize=changed(pose=lambda q, e: e.pose.shifted(GLOBAL)))
Inverted = variant(
    "inverted", localize=changed(pose=lambda q, e: Pose.from_center(e.pose.rotation.T, e.pose.center))
)
Boundless = variant("boundless", localize=changed(score=lambda q, e: float("inf")))
Unasking = variant("unasking", requires=frozenset({"masks"}))
Blind = variant("blind", localize=lambda self, q, m, s: Estimate(q.prior, 0.5))
Silent = type("Silent", (), {key: value for key, value in vars(Sound).items() if key != "requires"})
Silent.name, Silent.params_type = "silent", params("silent")


def prepare(self, city_map, references, workspace):
    assert len(references) == 3 and all(r.image.is_file() for r in references)
    self.parts = [
        np.load(workspace.part(f"{r.name}.npy", lambda file, r=r: np.save(file, r.pose.center)))
        for r in references
    ]


def retrieving(self, query, city_map, streams):
    nearest = min(self.parts, key=lambda center: np.linalg.norm(center - query.prior.center))
    return Estimate(query.prior.shifted((nearest - query.prior.center) * 0.1), 0.5)


def forgetful(self, city_map, references, workspace):
    workspace.part(f"part{next(COUNTER)}", lambda file: file.write_text("x"))
    self.parts = [r.pose.center for r in references]


def restless(self, city_map, references, workspace):
    path = workspace.part("a.npy", lambda file: np.save(file, np.array([next(COUNTER), 0, 0])))
    self.parts = [np.load(path)]


NEEDS = {"requires": frozenset({"image", "references"}), "localize": retrieving}
Retrieving = variant("retrieving", prepare=prepare, **NEEDS)
Forgetful = variant("forgetful", prepare=forgetful, **NEEDS)
Restless = variant("restless", prepare=restless, **NEEDS)
Batched = variant(
    "batched",
    batch_size=2,
    localize_batch=lambda self, queries, city_map, streams: [
        self.localize(q, city_map, s) for q, s in zip(queries, streams)
    ],
)
Unlike = variant(
    "unlike",
    batch_size=2,
    localize_batch=lambda self, queries, city_map, streams: [Estimate(q.prior, 0.5) for q in queries],
)
Weightless = variant("weightless", weight_files=lambda self: [Path("no/such/weights.onnx")])
TooSure = variant("too_sure", localize=changed(probability=lambda q, e: 1.2))
Lopsided = variant("lopsided", localize=changed(covariance=lambda q, e: np.triu(np.ones((6, 6)))))
Negative = variant("negative", localize=changed(covariance=lambda q, e: np.diag([1.0, 1, 1, 1, 1, -1])))
Small = variant("small", localize=changed(covariance=lambda q, e: np.eye(3)))
Misnamed = variant("misnamed", name="somebody_else")
Thawed = variant("thawed", params_type=params("thawed", frozen=False))
Unconfigured, Poor, Rich, Other, Torn = map(variant, ["unconfigured", "poor", "rich", "other", "torn"])
Reach = variant("reach", params_for_prior=lambda self, prior: 7)
'''
CONFIGS = {
    "unconfigured": None,
    "poor": "name: poor\n",
    "rich": "name: rich\nsteps: 3\nstride: 2\n",
    "other": "name: other\nsteps: 4\n",
    "torn": "name: [torn\n",
}
SOUND = ["sound", "retrieving", "batched", "talking"]
# Method, the check that finds the fault, a word of what is said.
BROKEN = [
    ("stateful", "any order", "other queries came before"),
    ("counting", "same again", "same streams"),
    ("dreamy", "same again", "same streams"),
    ("careless", "answers", "read-only"),
    ("crashing", "empty mask", "ZeroDivisionError: no pixels"),
    ("credulous", "empty mask", "answered"),
    ("speechless", "answers", "0 of 3 queries (I never know)"),
    ("exploding", "answers", "KeyError"),
    ("mistaken", "answers", "AttributeError"),
    ("wordless", "answers", "NoneType"),
    ("no_number", "pose", "not finite"),
    ("sheared", "pose", "no rotation"),
    ("abroad", "frame", "m from the prior"),
    ("inverted", "frame", "turned by"),
    ("boundless", "score", "inf"),
    ("unasking", "inputs", "'masks', which is no input"),
    ("blind", "empty mask", "not looked at"),
    ("silent", "inputs", "does not say what it requires"),
    ("forgetful", "preparation", "was made anew"),
    ("restless", "preparation", "another answer after a kill"),
    ("unlike", "batches", "another answer in a batch"),
    ("weightless", "weights", "no weights no/such/weights.onnx"),
    ("too_sure", "uncertainty", "1.2"),
    ("lopsided", "uncertainty", "not symmetric"),
    ("negative", "uncertainty", "negative eigenvalue"),
    ("small", "uncertainty", "(3, 3)"),
    ("misnamed", "name", "somebody_else"),
    ("thawed", "parameters", "not frozen"),
    ("unconfigured", "configuration", "there is no conf/method/unconfigured.yaml"),
    ("poor", "configuration", "lacks steps"),
    ("rich", "configuration", "no use for stride"),
    ("other", "configuration", "steps is 4"),
    ("torn", "configuration", "cannot be read"),
    ("reach", "prior width", "int"),
    ("absent", "entry point", "absent_module"),
]


@pytest.fixture
def check(capsys, monkeypatch, plug_in):
    """Checks a method of the package; returns what is printed (--json: checks by name) and the errors."""
    monkeypatch.syspath_prepend(plug_in)

    def run(name, *words, code=0):
        assert main(["check-method", name, *words]) == code
        out, err = capsys.readouterr()
        if "--json" in words:
            return {each["name"]: each for each in map(json.loads, out.splitlines())}, err
        return out, err

    return run


@pytest.fixture(scope="module")
def plug_in(tmp_path_factory) -> Path:
    """A package of methods as pip would install it, with its configuration."""
    folder = tmp_path_factory.mktemp("site")
    names = [*SOUND, *(name for name, _, _ in BROKEN)]
    texts = {name: CONFIGS.get(name, f"name: {name}\nsteps: 3\n") for name in names}
    files = {f"trial_conf/method/{name}.yaml": text for name, text in texts.items() if text is not None}
    methods = {name: f"trial_methods:{name.title().replace('_', '')}" for name in names}
    points = {
        "methods": methods | {"absent": "absent_module:Absent"},
        "config_sources": {"trial": "trial_conf"},
    }
    write_package(
        folder, "trial-methods", points, {"trial_methods.py": MODULE, "trial_conf/__init__.py": "", **files}
    )
    return folder


LESS_WORK = ["method.starts=2", "method.more_starts=1", "method.fine_generations=8"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("lodlocv2", []),
        ("contour_alignment", []),
        pytest.param("region", LESS_WORK, marks=pytest.mark.slow),
        ("prior_only", []),
        ("tracking", []),
    ],
)
def test_ours_keep_to_it(capsys, name, words):
    assert main(["check-method", name, *words]) == 0
    told = capsys.readouterr().out
    assert f"{name} conforms to the protocol." in told
    assert "  fault" not in told


def test_a_sound_plug_in(check):
    checks, _ = check("sound", "--json")
    assert [each["status"] for each in checks.values()] == 20 * ["ok"]
    assert "differs by seed" in checks["another seed"]["detail"]


@pytest.mark.parametrize(("name", "rule", "word"), BROKEN)
def test_each_violation_is_told_and_no_other(check, name, rule, word):
    checks, _ = check(name, "--json", code=1)
    (fault,) = [each for each in checks.values() if each["status"] != "ok"]
    assert (fault["name"], fault["status"]) == (rule, "fault")
    assert word in fault["detail"]


def test_what_is_offered_is_tried(check):
    preparation = check("retrieving", "--json")[0]["preparation"]
    assert preparation["detail"] == "3 parts, found again after a kill"
    assert check("batched", "--json")[0]["batches"]["detail"] == "up to 2 at a time, the same answers"


def test_settings_are_tried(check):
    assert "504 at most" in check("lodlocv2", "method.variant=no_refine")[0]
    # One of the wrong kind is no fault of the method.
    out, err = check("sound", "method.steps=x", code=2)
    assert "steps" in err
    assert not out


def test_what_a_method_prints_is_not_among_the_lines_for_machines(check):
    checks, err = check("talking", "--json")
    assert all(each["status"] == "ok" for each in checks.values())
    assert "I am looking" in err


def test_where_a_plug_in_raised_is_shown(check):
    told, _ = check("exploding", code=1)
    assert "in exploding" in told
    assert '    raise KeyError("oh")' in told
    assert "-> Its traceback is below. Where there is no answer, raise QueryFault with the reason." in told


def test_a_slip_is_not_taken_for_a_query_without_an_answer(check):
    told, _ = check("mistaken", code=1)
    assert "-> Its traceback is below.\n" in told
    assert "Estimate(query.pryor, 0.5)" in told
    assert "QueryFault" not in told


def test_a_violation_as_people_read_it(check):
    told, _ = check("stateful", code=1)
    assert "  fault   any order" in told
    assert "-> Keep no state between queries" in told
    assert told.endswith("\nstateful violates 1 rule of the protocol.\n")
