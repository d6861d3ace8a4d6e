"""What the tests of training a codec share: the exception from strict types that Optax needs."""

from collections.abc import Iterator

import pytest

from tests.promotion import promotion_of_libraries


@pytest.fixture(scope="session", autouse=True)
def libraries_may_promote() -> Iterator[None]:
    with promotion_of_libraries():
        yield
