"""Arrays, as every room names them."""

from typing import Any

from numpy.typing import NDArray

Array = NDArray[Any]
