"""`python -m xew.analysis.distance`: both matrices with spread and the paper's figures, for our robots and others."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.analysis.test_distance import stick
from xew.analysis.distance import Args, main
from xew.analysis.distances.motion import SCENES, command_flows, endpoint_errors, make_plans
from xew.protocol import ROBOT_NAMES
from xew.sim_warp.robots import ROBOTS

OF_ANY_URDF = {"dof", "links", "reach", "volume", "floor", "kinematic", "arm_base", "arm_alone"}


def gray_levels(images: np.ndarray) -> np.ndarray:
    """An embedding of images, cheaper than a network's."""
    return images.mean(axis=-1, dtype=np.float32).reshape(len(images), -1)


def without_weights(images: np.ndarray) -> np.ndarray:
    raise FileNotFoundError("the weights are not installed.")


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    out = tmp_path_factory.mktemp("distances")
    with pytest.MonkeyPatch.context() as patch:
        lines: list[str] = []
        patch.setattr("builtins.print", lambda *words, **_: lines.append(" ".join(map(str, words))))
        main(Args((str(stick(out, 0.2)),), out, seeds=3, perceptual=f"{__name__}:gray_levels"))
    return out, "\n".join(lines)


def test_both_matrices_are_written_with_spread_and_the_papers_figures(table: tuple[Path, str]) -> None:
    pairs = pd.read_csv(table[0] / "distances.csv")
    assert pairs.groupby("axis").size().to_dict() == {
        "kinematic": 15,
        "arm_base": 15,
        "arm_alone": 15,
        "appearance": 10,
        "perceptual": 10,
        "motion": 10,
    }
    by_axis = {axis: frame.set_index(["robot", "other"]) for axis, frame in pairs.groupby("axis")}
    row = by_axis["kinematic"].loc[("arx_x5", "piper")]
    assert row["value"] == pytest.approx(0.034, abs=0.002) and 0 < row["spread"] < 0.003 and row["published"] == 0.034
    assert by_axis["appearance"].loc[("aloha_agilex", "franka_panda")]["published"] == 0.235
    assert by_axis["arm_base"]["published"].isna().all() and by_axis["perceptual"]["published"].isna().all()
    for axis in ("appearance", "perceptual", "motion"):
        assert (by_axis[axis]["value"] > 0).all() and (by_axis[axis]["spread"] > 0).all()


def test_aloha_is_two_arms_of_the_make_of_the_arx(table: tuple[Path, str]) -> None:
    """What the arm's own frame is for: on its body an Aloha is far from the ARX, its arm is one."""
    pairs = pd.read_csv(table[0] / "distances.csv").set_index(["axis", "robot", "other"])["value"]
    assert pairs["kinematic", "aloha_agilex", "arx_x5"] > 0.18
    assert pairs["arm_alone", "aloha_agilex", "arx_x5"] < 0.03 < pairs["arm_base", "aloha_agilex", "arx_x5"]


def test_arms_of_one_make_move_alike_and_a_longer_arm_moves_otherwise(table: tuple[Path, str]) -> None:
    pairs = pd.read_csv(table[0] / "distances.csv").set_index(["axis", "robot", "other"])["value"]["motion"]
    assert pairs["aloha_agilex", "arx_x5"] == pairs.min() < 0.5 * pairs["aloha_agilex", "piper"]
    assert pairs["ur5_wsg", "franka_panda"] < pairs["arx_x5", "franka_panda"]


def test_motion_is_compared_where_all_robots_can_follow() -> None:
    flows = [np.zeros((4, 3, 5, 2)), np.full((4, 3, 5, 2), [3.0, 4.0])]
    np.testing.assert_array_equal(endpoint_errors(flows), [[0, 5], [5, 0]])
    by_task = command_flows(ROBOTS["piper"], make_plans())
    assert list(by_task) == list(SCENES)
    assert all(flow.shape[1:] == (30, 40, 2) and np.abs(flow).max() > 1 for flow in by_task.values())


def test_a_row_for_each_feature_of_each_robot(table: tuple[Path, str]) -> None:
    rows = pd.read_csv(table[0] / "robots.csv").set_index(["robot", "feature"])
    assert set(rows.loc["piper"].index) == {*OF_ANY_URDF, "appearance", "perceptual", "motion"}
    assert set(rows.loc["stick_0.2"].index) == OF_ANY_URDF
    pairs = pd.read_csv(table[0] / "distances.csv")
    for robot in (*ROBOT_NAMES, "stick_0.2"):
        mine = pairs[(pairs["axis"] == "kinematic") & ((pairs["robot"] == robot) | (pairs["other"] == robot))]
        others = mine["robot"].where(mine["robot"] != robot, mine["other"])
        # A robot that is not the paper's is no neighbor of those that are.
        assert rows.loc[(robot, "kinematic"), "value"] == pytest.approx(mine["value"][others.isin(ROBOT_NAMES)].mean())
    assert rows.loc[("ur5_wsg", "volume"), "published"] == 2.771


def test_what_is_printed_says_what_is_what(table: tuple[Path, str]) -> None:
    out, text = table
    assert "its workspace is compared, its looks are not" in text and "stick_0.2" in text
    assert "(0.195)" in text and "(1.639)" in text and "± is the standard deviation of one draw over 3 seeds" in text
    assert str(out / "distances.csv") in text


def test_one_seed_has_no_spread(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    main(Args(out=tmp_path, seeds=1, looks=False))
    assert (pd.read_csv(tmp_path / "distances.csv")["spread"] == 0).all()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["distances.csv", "robots.csv"]
    assert "±" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (Args(seeds=0), "--seeds is 0"),
        (Args(perceptual="xew.metrics:lpisp"), "cannot be imported"),
        (Args(perceptual="nothing"), "expected module:NAME"),
        (Args(("no/such.urdf",), looks=False), "there is no robot at no/such.urdf"),
        (Args(("pipper",), looks=False), "did you mean 'piper'"),
        (Args(("piper",), looks=False), "is named piper, as another robot"),
        (Args(seeds=1, perceptual=f"{__name__}:without_weights"), "the weights are not installed. Or leave it out"),
    ],
)
def test_mistakes_are_told_in_words(args: Args, message: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit) as exit_:
        main(Args(args.robot, tmp_path / "out", args.seeds, args.looks, args.perceptual))
    assert exit_.value.code == 2 and message in capsys.readouterr().err and not (tmp_path / "out").exists()
