"""Figures of the pages on outcomes and changed scenes: of the published tables, or of the scores where no table has them."""

from functools import cache

import numpy as np
import pandas as pd
import pytest

from tests.analysis.test_results_pages import RESULTS, demand, read_rows, row_of
from xew.analysis.beyond import Shifts
from xew.analysis.scores import read_scores
from xew.protocol import FAULT_STRIDE, GROUND_TRUTH, HELD_OUT_ROBOTS, SEEN_ROBOTS
from xew.statistics import policy_outcomes

FRANKA, PIPER = HELD_OUT_ROBOTS
GROUPS = {"ALOHA, ARX, UR5": SEEN_ROBOTS, "Piper": (PIPER,), "Franka": (FRANKA,)}
"""Robots by their names on the page, in the order of its columns."""
TABLES = {
    SEEN_ROBOTS: ("aloha_agilex_arx_x5_ur5_wsg", "Pooled: ALOHA-AgileX, ARX-X5, UR5"),
    (PIPER,): ("piper", "Piper"),
    (FRANKA,): ("franka_panda", "Franka (Panda)"),
}
"""Published table of each, and its title in the table of policies."""
RANKED = ("Pearson's r", "Spearman", "MMRV")
MEASURES = {
    "policy ranking, Pearson's r ↑": ("Pearson's r", "release"),
    "Spearman ↑": ("Spearman", "release"),
    "MMRV ↓": ("MMRV", "release"),
    "r of the truth through the codec": ("Pearson's r", "truth through"),
    "r of another robot's episode": ("Pearson's r", "another"),
    "r of the pasted render": ("Pearson's r", "pasted"),
    "outcome accuracy ↑": ("Outcome accuracy", "release"),
    "progress error ↓": ("Progress error", "release"),
    "hallucinated success ↓": ("Hallucinated success", "release"),
    "retrieval of 8, chance 0.125 ↑": ("Counterfactual retrieval", "release"),
    "retrieval by LPIPS ↑": ("Retrieval by LPIPS", "release"),
}
"""Column and model of the published tables, by the page's label."""
BENEATH = {
    "the same, truth through the codec": [("Outcome accuracy", "truth through"), ("Counterfactual retrieval", "truth through")],
    "the same, another robot's episode": [("Outcome accuracy", "another")],
    "the same, pasted render": [("Outcome accuracy", "pasted")],
}
"""The same for labels that stand beneath another row, each time that they do."""


def published(measure: str, model: str, robots: tuple[str, ...]) -> list[float]:
    """A value of the published tables with the ends of its interval."""
    file, title = TABLES[robots]
    table = pd.read_csv(RESULTS / "outcome" / "tables" / f"{'policy_ranking' if measure in RANKED else file}.csv")
    table = table[table["block"] == title] if measure in RANKED else table
    found = table[table["row"].str.startswith(model) & table["column"].str.contains(measure, regex=False)]
    return found[["value", "low", "high"]].to_numpy(float)[0].tolist()


@pytest.mark.parametrize("label", MEASURES)
def test_outcomes(label: str) -> None:
    for cell, robots in zip(row_of("outcome", label), GROUPS.values(), strict=True):
        demand(cell, published(*MEASURES[label], robots)[: 3 if "[" in cell else 1])


@pytest.mark.parametrize("label", BENEATH)
def test_outcomes_of_baselines(label: str) -> None:
    for number, measure in enumerate(BENEATH[label]):
        for cell, robots in zip(row_of("outcome", label, number), GROUPS.values(), strict=True):
            demand(cell, published(*measure, robots)[:1])


@cache
def outcomes() -> pd.DataFrame:
    """True and judged success of every graded video."""
    return policy_outcomes(read_scores(RESULTS / "outcome" / "scores.parquet").rows)


@pytest.mark.parametrize("name", GROUPS)
def test_rates_of_policies(name: str) -> None:
    own = outcomes().query("model == 'release'")
    rates = own[own["robot"].isin(GROUPS[name])].groupby("policy")[["true", "judged"]].mean()
    for label, column in (("simulator", "true"), ("video", "judged")):
        [cell] = row_of("outcome", f"{name}: {label}")
        demand(cell, rates[column].to_list())


def test_sentences_on_outcomes() -> None:
    """Shares of successes that are shown, and of right outcomes where the judge reads the true video right."""
    graded, page = outcomes(), " ".join((RESULTS / "outcome" / "README.md").read_text().split())
    graded = graded.assign(right=graded["true"] == graded["judged"])
    cell = ["task", "seed", "robot", "policy"]
    truth = graded[graded["model"] == GROUND_TRUTH].set_index(cell)["right"].rename("readable")
    own = graded[graded["model"] == "release"].join(truth, on=cell)
    shown, right, readable = [], [], []
    for robots in GROUPS.values():
        group = own[own["robot"].isin(robots)]
        shown.append(100 * group.loc[group["true"] == 1, "judged"].mean())
        right.append(100 * group.loc[group["readable"], "right"].mean())
        readable.append(100 * group["readable"].mean())
    assert "as one in {:.0f} % of cases on training robots, {:.0f} % on Piper and {:.0f} % on Franka".format(*shown) in page
    assert "right in {2:.0f} % on Franka, {1:.0f} % on Piper and {0:.0f} % on training robots".format(*right) in page
    assert f"the judge reads {100 - readable[2]:.0f} % of the *true* videos wrong" in page
    assert f"{100 * own['true'].mean():.0f} % of them succeed" in page


TRAINED = {
    "LPIPS of the experts' episodes ↓": "lpips",
    "mean outcome accuracy ↑": "outcome_accuracy",
    "mean progress error ↓": "progress_error",
    "successes among 78 failures ↓": "hallucinated_success",
    "strict object error [px] ↓": "trajectory_error_strict",
}
"""Metric of each row on training on failures; LPIPS is of the experts' episodes alone, and successes are counted."""


@pytest.mark.parametrize("label", TRAINED)
def test_training_on_failures(label: str) -> None:
    rows = read_scores(RESULTS / "outcome" / "training_on_failures.parquet").rows
    rows = rows[(rows["metric"] == TRAINED[label]) & ((rows["metric"] != "lpips") | (rows["seed"] < FAULT_STRIDE))]
    by_model = rows.groupby("model")["value"]
    values = by_model.sum() if "among" in label else by_model.mean()
    assert by_model.size().nunique() == 1 and ("among" not in label or by_model.size().iloc[0] == 78)
    for cell, share in zip(row_of("outcome", label), ("0", "0.25", "0.5"), strict=True):
        demand(cell, [values[f"failures_{share}_{seed}"] for seed in (0, 1)])


@cache
def shifts() -> Shifts:
    folder = RESULTS / "shifts"
    return Shifts(
        read_scores(folder / "scores.parquet"), [read_scores(path) for path in (folder / "shifted").glob("*.parquet")]
    )


CASES = {"nothing": [""], "Franka, never seen": [FRANKA], "Piper, never seen": [PIPER]}
CASES |= {name: [f"{name}:{level}" for level in (1, 2, 3)] for name in ("light", "table", "camera")}
CASES |= {name: [f"{name}:{level}" for level in (1, 2, 3)] for name in ("height", "clutter", "background")}


@pytest.mark.parametrize("label", CASES)
def test_changed_scenes(label: str) -> None:
    for cell, model in zip(row_of("shifts", label), shifts().models, strict=True):
        means = [shifts().mean(model, case, metric) for case in CASES[label] for metric in ("lpips", "mask_iou")]
        demand(cell, [mean.value for mean in means if mean])


def test_the_answer_on_changed_scenes() -> None:
    """The costs in the page's answer, without changes in training."""
    model, page = shifts().models[0], (RESULTS / "shifts" / "README.md").read_text()

    def costs(cases: list[str]) -> list[float]:
        found = [shifts().cost(model, case, "lpips") for case in cases]
        return [cost.value for cost in found if cost]

    assert np.round(costs(list(HELD_OUT_ROBOTS)), 2).tolist() == [0.03, 0.03] and "A new robot adds 0.03 to LPIPS" in page
    ends = [f"{end(costs(CASES[factor])):.2f}" for factor in ("light", "table") for end in (min, max)]
    assert "A new lamp adds {} to {} and a new table {} to {}, at every level".format(*ends) in page
    assert {"light:1", "light:2", "light:3", "table:1", "table:2", "table:3"} == set(
        shifts().compare_changes(model, "lpips")["more"]
    )
    assert len(read_rows("shifts")) == 1 + len(CASES)
