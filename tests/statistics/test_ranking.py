"""Policy ranking against values worked out by hand and SciPy's."""

import numpy as np
import pandas as pd
import pytest
from scipy.stats import pearsonr, spearmanr

from xew.protocol import FAULT_GRADES, FAULT_SEVERITIES, join_fault
from xew.statistics.means import fixed_mean
from xew.statistics.ranking import (
    RANKINGS,
    mean_max_rank_violation,
    policy_outcomes,
    policy_ranking,
    rank_policies,
    ranking_interval,
)


@pytest.mark.parametrize(
    ("judged", "true", "violation"),
    [
        ([0.2, 0.5, 0.9], [0.1, 0.4, 0.8], 0),
        ([0.5, 0.2, 0.9], [0.1, 0.4, 0.8], (0.3 + 0.3 + 0) / 3),  # one neighboring pair is wrong
        ([0.9, 0.5, 0.2], [0.1, 0.4, 0.8], (0.7 + 0.4 + 0.7) / 3),  # all pairs are
        ([0.5, 0.5, 0.5], [0.1, 0.4, 0.8], (0.7 + 0.4 + 0) / 3),  # a tie of what differs counts for the lower policy
        ([0.1, 0.4, 0.8], [0.5, 0.5, 0.5], 0),  # what does not differ cannot be ranked wrongly
    ],
)
def test_mmrv_is_the_worst_wrong_pair_of_each_policy(judged: list, true: list, violation: float) -> None:
    assert mean_max_rank_violation(np.array(judged), np.array(true)) == pytest.approx(violation)


def ranking_rows(scenes: int = 40) -> pd.DataFrame:
    rng = np.random.default_rng(0)
    rows = [
        {
            "task": f"task{seed % 4}",
            "seed": seed,
            "policy": policy,
            "true": float(rng.random() < rate),
            "judged": float(rng.random() < rate),
        }
        for seed in range(scenes)
        for policy, rate in enumerate((0.1, 0.4, 0.6, 0.9))
    ]
    return pd.DataFrame(rows)


def test_policies_are_ranked_by_their_rates_with_intervals_over_scenes() -> None:
    rows = ranking_rows()
    ranking = policy_ranking(rows.sample(frac=1, random_state=1))
    rates = rows.groupby("policy")[["judged", "true"]].mean().to_numpy().T
    expected = (pearsonr(*rates).statistic, spearmanr(*rates).statistic, mean_max_rank_violation(*rates))
    assert [mean.value for mean in ranking.values()] == pytest.approx(expected)
    assert list(ranking) == list(RANKINGS)
    for mean in ranking.values():
        low, high = mean.interval()
        assert low <= mean.value <= high and high > low


@pytest.mark.parametrize(
    ("name", "value", "draws", "expected"),
    [
        ("mmrv", 0.1, (0.12, 0.3), (0.0, 0.3)),  # mirrored: -0.1 to 0.08
        ("mmrv", 0.1, (0.05, 0.12), (0.05, 0.15)),
        ("pearson", np.tanh(1.0), (np.tanh(0.4), np.tanh(0.9)), (np.tanh(0.4), np.tanh(1.6))),
        ("spearman", 1.0, (0.9, 1.0), (0.9, 1.0)),
        # A draw of 1 has its mirror image at -1; one of 0.999 instead bounds the interval.
        ("pearson", 0.99, (0.98, 1.0), (np.tanh(2 * np.arctanh(0.99) - np.arctanh(0.999)), 1.0)),
    ],
)
def test_intervals_reach_as_far_to_the_other_side(
    name: str, value: float, draws: tuple[float, float], expected: tuple[float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    mean = fixed_mean(np.array([value, *draws]), 10, 10)
    monkeypatch.setattr(type(mean), "interval", lambda _: draws)
    assert ranking_interval(name, mean) == pytest.approx(expected)


def test_scenes_are_all_that_any_policy_has() -> None:
    rows = ranking_rows()
    rare = rows[(rows["policy"] != 2) | (rows["seed"] < 3)]
    low, high = policy_ranking(rare)["pearson"].interval()
    assert low < high, "a policy of three scenes alone would have no interval"


def test_one_policy_has_no_rank() -> None:
    with pytest.raises(ValueError, match="1 policies to rank"):
        policy_ranking(ranking_rows().query("policy == 1"))


def score_rows(judged: dict[int, tuple[int, ...]], true: dict[int, tuple[int, ...]], robot: str = "piper") -> list[dict]:
    """Rows of a score table: outcomes of policies (keys) in scenes 0, 1, ..."""
    rows = []
    for policy, outcomes in judged.items():
        for seed, (shown, success) in enumerate(zip(outcomes, true[policy], strict=True)):
            key = {"model": "m", "condition": "c", "task": "t", "seed": join_fault(policy, seed), "robot": robot}
            rows.append(key | {"metric": "outcome_accuracy", "value": float(shown == success)})
            rows += [] if success else [key | {"metric": "hallucinated_success", "value": float(shown)}]
    return rows


def test_rates_of_a_score_table_rank_graded_policies() -> None:
    true = {0: (1, 1, 1, 1), 1: (1, 1, 0, 0), 2: (0, 0, 0, 0)}
    judged = {0: (1, 1, 1, 0), 1: (1, 0, 0, 0), 2: (1, 1, 0, 0)}  # rates .75, .25, .5 instead of 1, .5, 0
    table = rank_policies(pd.DataFrame(score_rows(judged, true)), {"Piper": ["piper"]}).set_index("measure")
    assert table["value"].to_dict() == pytest.approx({"pearson": 0.5, "spearman": 0.5, "mmrv": (0 + 0.5 + 0.5) / 3})
    assert set(table["policies"]) == {3} and set(table["scenes"]) == {4} and set(table["robot"]) == {"Piper"}


def test_baselines_come_last_in_their_order() -> None:
    rows = pd.DataFrame(score_rows({0: (1, 1), 1: (0, 0)}, {0: (1, 1), 1: (0, 0)}))
    shuffled = pd.concat([rows.assign(model=model) for model in ("ground_truth", "mine", "copy_first_frame", "yours")])
    ranking = rank_policies(shuffled, {"Piper": ["piper"]})
    assert [*dict.fromkeys(ranking["model"])] == ["mine", "yours", "copy_first_frame", "ground_truth"]


def test_experts_alone_are_not_ranked() -> None:
    expert = {0: (1, 1)}
    assert rank_policies(pd.DataFrame(score_rows(expert, expert)), {"Piper": ["piper"]}).empty


def test_a_policy_without_a_rate_is_left_out() -> None:
    rates = np.array([[0.2, np.nan, 0.5, 0.9], [0.1, np.nan, 0.8, 0.4]])
    for name, function in RANKINGS.items():
        assert function(*rates) == pytest.approx(function(*rates[:, [0, 2, 3]])), name


def test_outcomes_of_a_score_table() -> None:
    rows = score_rows({0: (1, 0), 2: (1, 0)}, {0: (1, 1), 2: (0, 0)})
    outcomes = policy_outcomes(pd.DataFrame(rows)).set_index(["policy", "seed"])
    assert outcomes["true"].to_dict() == {(0, 0): 1, (0, 1): 1, (1, 0): 0, (1, 1): 0}
    assert outcomes["judged"].to_dict() == {(0, 0): 1, (0, 1): 0, (1, 0): 1, (1, 1): 0}


def test_a_policy_carries_out_the_commands_of_one_grade_in_every_scene() -> None:
    """Scenes have other faults, and one model lacks a command: the place of the others does not change."""
    kinds = list(FAULT_SEVERITIES)
    first = {kind: 1 + sum(map(len, list(FAULT_SEVERITIES.values())[: kinds.index(kind)])) for kind in kinds}
    worst, middle, mild = first["stay_open"], first["stop"] + 1, first["grasp_offset"]
    seeds = {0: (0, worst, mild, middle), 1: (middle, 0, worst)}
    rows = [
        {"model": model, "condition": "c", "task": "t", "seed": join_fault(fault, scene), "robot": "piper"}
        | {"metric": "outcome_accuracy", "value": 1.0}
        for model in ("whole", "gap")
        for scene, faults in seeds.items()
        for fault in faults
        if (model, fault) != ("gap", mild)
    ]
    rows += [row | {"metric": "hallucinated_success", "value": 0.0} for row in rows if row["seed"] == join_fault(worst, 0)]
    places = policy_outcomes(pd.DataFrame(rows)).groupby(["seed", "model"])["policy"].apply(sorted)
    assert places.to_list() == [[0, 2, 3], [0, 1, 2, 3], [0, 1, 2], [0, 1, 2]]
    outcomes = policy_outcomes(pd.DataFrame(rows)).query("seed == 0 and model == 'whole'").set_index("policy")
    assert outcomes["true"].to_dict() == {0: 1, 1: 1, 2: 1, 3: 0}, "the worst fault failed"


def test_grades_of_faults() -> None:
    assert len(FAULT_GRADES) == 1 + sum(map(len, FAULT_SEVERITIES.values()))
    assert FAULT_GRADES[:6] == pytest.approx((0, 0.2, 0.4, 0.6, 0.8, 1))
