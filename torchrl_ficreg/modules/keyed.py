"""Key names that can be changed with ``set_keys``, as in TorchRL's losses."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

from tensordict.utils import NestedKey, unravel_key


class KeyedMixin:
    """Adds ``tensor_keys`` and :meth:`set_keys` to a world model, a planner, a policy or an environment.

    A subclass defines its default keys as a dataclass ``_AcceptedKeys``, calls :meth:`set_keys` in its constructor and
    overrides :meth:`_apply_keys`.

    Attributes:
        tensor_keys: the keys in use.
    """

    @dataclass(frozen=True)
    class _AcceptedKeys:
        """Keys that :meth:`set_keys` can change."""

    tensor_keys: _AcceptedKeys

    def set_keys(self, **keys: NestedKey | None) -> None:
        """Changes keys of the tensordict that is read and written.

        Args:
            **keys: new keys by their names in ``tensor_keys``. Nested keys are tuples of strings; None restores a default.

        Raises:
            ValueError: an unknown name.
        """
        defaults = {field.name: field.default for field in fields(self._AcceptedKeys)}
        unknown = sorted(keys.keys() - defaults.keys())
        if unknown:
            raise ValueError(
                f"{type(self).__name__} has no key {', '.join(unknown)}: set_keys changes {', '.join(defaults)}."
            )
        given = {name: unravel_key(defaults[name] if key is None else key) for name, key in keys.items()}
        self.tensor_keys = replace(getattr(self, "tensor_keys", None) or self._AcceptedKeys(), **given)
        self._apply_keys()

    def _apply_keys(self) -> None:
        """Updates what depends on ``tensor_keys``, such as ``in_keys`` and ``out_keys``."""
