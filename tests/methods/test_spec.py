"""A method as a value: timelines of stages, what stages read, features."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import fields, replace

import pytest

from rtgs.core.errors import RtgsError
from rtgs.methods import MethodSpec, StageSpec, find_method, is_own, method_names, own_methods
from rtgs.methods.family import DIFFUSE, REFLECTION, TRANSMITTANCE
from rtgs.methods.settings import MethodSettings, ReflectionSettings, TransmittanceSettings
from rtgs.train.settings import LOSS_WEIGHTS, LossSettings, ScheduleSettings

PLAN = ScheduleSettings(total=100)


def unbuilt(setup):
    raise AssertionError("a plan composes no model")


def settings(start: float, third: float = 0.6, enabled: bool = True) -> MethodSettings:
    return MethodSettings(
        name="rtgs",
        reflection=ReflectionSettings(start=start),
        transmittance=TransmittanceSettings(start=third, enabled=enabled),
    )


def stages(chosen: MethodSettings, *, transparent: bool) -> list[tuple[str, int, int]]:
    found = find_method("rtgs").timeline(chosen, PLAN, transparent=transparent)
    assert find_method("rtgs_printed").timeline(chosen, PLAN, transparent=transparent) == found
    return [(stage.name, stage.from_step, stage.until) for stage in found]


def test_a_timeline_has_the_stages_that_the_run_gets():
    whole = [("diffuse", 0, 30), ("reflection", 30, 60), ("transmittance", 60, 100)]
    assert stages(settings(0.3), transparent=True) == whole
    two = [("diffuse", 0, 30), ("reflection", 30, 100)]
    assert stages(settings(0.3), transparent=False) == two
    assert stages(settings(0.3, enabled=False), transparent=True) == two
    assert stages(settings(1.0), transparent=True) == [("diffuse", 0, 100)]
    assert stages(settings(0.3, third=1.0), transparent=True) == two
    assert stages(settings(0.0), transparent=False) == [("reflection", 0, 100)]


def test_a_stage_before_its_turn_is_refused_with_both_keys():
    with pytest.raises(
        ValueError, match=r"transmittance\.start=0\.2 is step 20 of 100.*method\.reflection\.start=0\.3"
    ):
        stages(settings(0.3, third=0.2), transparent=True)


def test_what_a_method_declares_is_checked():
    with pytest.raises(ValueError, match="its first stage must start at once"):
        MethodSpec("late", (REFLECTION,), unbuilt)
    with pytest.raises(ValueError, match="its first stage must start at once, in every scene"):
        MethodSpec("sometimes", (replace(DIFFUSE, needs_object=True),), unbuilt)
    with pytest.raises(ValueError, match="stage reflection names no start_key"):
        MethodSpec("keyless", (DIFFUSE, replace(REFLECTION, start_key="")), unbuilt)
    with pytest.raises(ValueError, match="two stages of one name: diffuse, diffuse"):
        MethodSpec("twice", (DIFFUSE, replace(DIFFUSE, start_key="method.a")), unbuilt)
    with pytest.raises(ValueError, match="has fog: known are harmonics, surface, mirror, microfacet, glass"):
        MethodSpec("foggy", (DIFFUSE,), unbuilt, frozenset({"fog"}))
    with pytest.raises(ValueError, match="method 2dgs has no stage 'reflection': it has diffuse"):
        find_method("2dgs").stage("reflection")


def test_a_method_of_one_stage_may_read_all_its_settings():
    """Materials in a single stage train with the numbers they are given."""
    spec = MethodSpec("deferred", (StageSpec("deferred"),), unbuilt)
    chosen = replace(MethodSettings(), materials=replace(MethodSettings().materials, specular=0.3))
    assert spec.stage("deferred").reads(chosen) == chosen
    assert DIFFUSE.reads(chosen) == DIFFUSE.reads(MethodSettings())


def test_the_methods_of_this_package():
    own = (
        "2dgs",
        "3dgs",
        "3dgs_dr",
        "gaussian_shader",
        "ref_gaussian",
        "ref_gs",
        "envgs",
        "rtgs",
        "rtgs_printed",
    )
    assert method_names()[: len(own)] == own
    assert all(is_own(spec) for spec in own_methods())
    assert [spec.object_stage(settings(0.3)) for spec in own_methods()] == [None] * 7 + [TRANSMITTANCE] * 2
    assert find_method("rtgs").object_stage(settings(0.3, enabled=False)) is None


def test_methods_are_found_without_torch():
    code = "import sys, rtgs.methods as m; m.find_method('rtgs'); print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_where_there_is_no_object_the_stage_before_goes_on():
    spec = find_method("rtgs")
    before = spec.before("transmittance", settings(0.3), PLAN)
    assert (before.name, before.from_step, before.until) == ("reflection", 30, 100)
    assert spec.before("transmittance", settings(1.0), PLAN).name == "diffuse"
    last = StageSpec("polish", lambda settings, schedule: 80, "method.reflection.start")
    longer = MethodSpec("longer", (DIFFUSE, REFLECTION, TRANSMITTANCE, last), unbuilt)
    assert longer.before("transmittance", settings(0.3), PLAN).name == "reflection"


def unread(method: str, **loss: float) -> list[str]:
    found = find_method(method).unread_losses(MethodSettings(name=method, loss=LossSettings(**loss)))
    return [str(decision) for decision in found]


def test_a_weight_that_no_stage_reads_is_told():
    assert unread("2dgs", perceptual=0.02) == ["method.loss.perceptual=0.02 has no effect: 2dgs has no such loss"]
    everything = dict.fromkeys(LOSS_WEIGHTS, 0.03)
    for method in ("2dgs", "3dgs"):
        names = [text.split("=")[0].split(".")[-1] for text in unread(method, **everything)]
        assert names == ["perceptual", "specular", "transmission_depth"]
    depth = "method.loss.transmission_depth=0.03 has no effect: envgs has no such loss"
    late = "method.loss.specular=0.03 has no effect: no stage of envgs reads it where method.loss.specular_start is 0.5"
    assert unread("envgs", **everything, specular_start=0.5) == [f"{late}, let it start earlier", depth]
    assert unread("envgs", **everything, specular_start=0.1) == [depth]
    assert unread("rtgs", **everything) == []
    for method in ("3dgs_dr", "ref_gs", "ref_gaussian"):
        names = [text.split("=")[0].split(".")[-1] for text in unread(method, **everything, specular_start=0.1)]
        assert names == ["perceptual", "specular", "transmission_depth"]
        reads = find_method(method).stage("reflection").reads
        asked = LossSettings(perceptual=0.02, perceptual_start=0.1, specular=0.2, specular_start=0.1)
        one, other = (reads(MethodSettings(name=method, loss=loss)) for loss in (asked, LossSettings()))
        assert one == other == reads(one)


def test_a_weight_that_is_off_or_the_default_is_not_told():
    assert [unread(spec.name) for spec in own_methods()] == [[]] * len(own_methods())
    forgets = StageSpec("diffuse", reads=lambda settings: replace(settings, loss=LossSettings()))
    spec = MethodSpec("forgetful", (forgets,), unbuilt)
    asked = replace(MethodSettings(), loss=LossSettings(normal=LossSettings().normal, distortion=0.1, mono_normal=0.0))
    (decision,) = spec.unread_losses(asked)
    assert str(decision) == "method.loss.distortion=0.1 has no effect: forgetful has no such loss"


def test_the_weights_of_losses_are_known():
    shares = ("_start", "_gain", "_masked", "_opaque", "_until", "_target")  # shares of the run, factors, aims
    numbers = [each.name for each in fields(LossSettings) if each.type == "float" and not each.name.endswith(shares)]
    assert tuple(numbers) == LOSS_WEIGHTS


def test_pictures_of_another_program_are_a_method_that_trains_nothing():
    external = find_method("external")
    assert (external.stages, external.elsewhere) == ((), True)
    assert external.name not in method_names()
    assert external not in own_methods()
    assert external.unread_losses(settings(0.3)) == ()
    with pytest.raises(RtgsError, match="method=external trains nothing"):
        external.build(None)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="its pictures come from elsewhere, so it has no stages"):
        replace(external, stages=(StageSpec("a"),))
    with pytest.raises(ValueError, match="its first stage must start at once"):
        replace(external, elsewhere=False)
