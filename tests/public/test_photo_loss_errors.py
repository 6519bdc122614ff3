"""Errors of a rendering in photo_loss: told or passed on, and none takes the recordings away."""

import json
import signal
import warnings
from pathlib import Path

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.process import run_python

mi = pytest.importorskip("mitsuba")
pytestmark = pytest.mark.mitsuba

STEPS = 6
AT_EACH = range(1, 100)


@pytest.fixture(autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")
    eg.register_plugins()


def failing(kind, error, at):
    """An integrator whose derivatives fail at some of its calls, and that counts these."""

    class Failing(type(mi.load_dict({"type": kind}))):
        calls = 0

        def render_backward(self, *arguments, **options):
            self.calls += 1
            if self.calls in at:
                error()
            return super().render_backward(*arguments, **options)

    return Failing(mi.Properties(kind))


def throwing(error):
    def throw():
        raise error

    return throw


def fit(error=None, at=(), kind="prb"):
    """The fit of a grey wall to a darker photo, the calls of the integrator, and the warnings."""
    grey = {"type": "bitmap", "data": mi.TensorXf(np.full((8, 8, 3), 0.5)), "raw": True}
    film = {"type": "hdrfilm", "width": 12, "height": 12, "rfilter": {"type": "box"}}
    view = mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])
    coat = {"type": "diffuse", "reflectance": grey}
    parts = {
        "light": {"type": "constant"},
        "camera": {"type": "perspective", "film": film, "to_world": view},
        "wall": {"type": "rectangle", "bsdf": coat},
    }
    integrator, photo = failing(kind, error, at), np.full((12, 12, 3), 0.3, np.float32)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        loss = eg.plugins.photo_loss(
            mi.load_dict({"type": "scene", **parts}),
            "wall.bsdf.reflectance",
            [photo],
            integrator=integrator,
        )
        result = eg.fit(loss=loss, size=(8, 8), gaussians=4, iterations=STEPS, progress=False)
    return result, integrator.calls, [str(warning.message) for warning in caught]


@pytest.fixture(scope="module")
def undisturbed():
    mi.set_variant("llvm_ad_rgb")
    return fit()


RECORDED = """
import json, sys
sys.path[:0] = [{folder!r}, {folder!r} + "/.."]
from test_photo_loss_errors import eg, fit, mi, throwing
mi.set_variant("llvm_ad_rgb")
eg.register_plugins()
error = throwing(RuntimeError("jit_malloc(): out of memory!"))
for calls in ((), (1,), (2,)):
    result, count, texts = fit(error, calls)
    print(json.dumps([result.loss, count, texts]))
"""


def test_a_passing_error_is_told_once_and_the_next_steps_are_replayed():
    """In a process of its own: where several threads were, nothing is recorded."""
    process = run_python(RECORDED.format(folder=str(Path(__file__).parent)))
    rows = [json.loads(line) for line in process.stdout.splitlines()]
    [loss, calls, texts], *failed = rows
    assert calls < STEPS and not texts and len(failed) == 2
    for other, calls, texts in failed:
        assert calls < STEPS
        assert len(texts) == 1 and "\n" not in texts[0]
        begin = "photo_loss: a recording failed, its step renders anew: jit_malloc"
        assert texts[0].startswith(begin)
        assert other == pytest.approx(loss, rel=1e-5)


@pytest.mark.parametrize("kind", [RuntimeError, ValueError, TypeError, MemoryError])
def test_a_lasting_error_is_passed_on(kind):
    with pytest.raises(kind, match=r"^the lamp is out$"):
        fit(throwing(kind("the lamp is out")), AT_EACH)


def test_integrators_that_dr_jit_cannot_record_render_every_step_in_silence(undisturbed):
    result, calls, texts = fit(kind="direct_projective")
    assert calls > STEPS and not texts
    assert result.loss == pytest.approx(undisturbed[0].loss, rel=0.05)


@pytest.mark.parametrize("call", [1, 2])
@pytest.mark.parametrize("press", [throwing(KeyboardInterrupt()), None])
def test_ctrl_c_in_a_rendering_ends_the_fit_with_its_result(call, press):
    press = press or (lambda: signal.raise_signal(signal.SIGINT))
    with pytest.raises(eg.Interrupted) as caught:
        fit(press, [call])
    result = caught.value.result
    assert result.stopped == "interrupted" and result.iterations < STEPS
    assert len(result.gaussians) == 4
