"""Order of training samples, with replayed ones and without."""

import numpy as np

from xew.model.training.data import Batch
from xew.model.training.order import make_dataset


class Numbers:
    """Ten fresh samples, and five of replayed episodes."""

    fresh = 10

    def __len__(self) -> int:
        return 15

    def __getitem__(self, index: int) -> Batch:
        return Batch(np.float32(index), {}, np.int32(0))


def test_batches_without_replay_are_those_of_earlier_versions() -> None:
    batches = iter(make_dataset(Numbers(), 4, seed=3))  # type: ignore[arg-type]
    assert [next(batches).latents.astype(int).tolist() for _ in range(3)] == [[4, 6, 9, 7], [5, 3, 1, 8], [2, 0, 8, 1]]


def test_batches_with_replay_go_on_where_they_stopped() -> None:
    batches = iter(make_dataset(Numbers(), 4, seed=0, replay=0.25))  # type: ignore[arg-type]
    drawn, position = [next(batches).latents for _ in range(6)], batches.get_state()
    assert [(batch >= 10).tolist() for batch in drawn] == [[False, False, False, True]] * 6
    continued = iter(make_dataset(Numbers(), 4, seed=0, replay=0.25))  # type: ignore[arg-type]
    continued.set_state(position)
    for _ in range(3):
        np.testing.assert_array_equal(next(continued).latents, next(batches).latents)
