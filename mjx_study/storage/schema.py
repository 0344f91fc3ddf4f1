"""JSON of a study's folder read against a schema; errors name the key in one line."""

import functools
from typing import Annotated, Any, Final

from pydantic import Field, TypeAdapter, ValidationError

Finite = Annotated[float, Field(allow_inf_nan=False, strict=True)]
_ADAPTER: Final = functools.cache(TypeAdapter)


def validated(schema: Any, content: bytes | str) -> Any:
    """Read JSON of a type; a ValueError names the first key that violates it, and counts the others."""
    try:
        return _ADAPTER(schema).validate_json(content)
    except ValidationError as error:
        found = error.errors(include_url=False, include_input=False)
    first = found[0]
    key = ".".join(map(str, first["loc"]))
    raised = first.get("ctx", {}).get("error")  # from a validator of ours; pydantic adds words to its message
    reason = str(raised) if isinstance(raised, ValueError) else first["msg"]
    more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
    raise ValueError(f"{key}{': ' * bool(key)}{' '.join(reason.split())}{more}")
