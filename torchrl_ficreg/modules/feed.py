"""Passes tensors to a network by the names of its ``in_keys``; by position where the names do not tell them apart."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import torch
from tensordict import is_tensor_collection, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key

from torchrl_ficreg._torchrl_compat import keyword_arguments
from torchrl_ficreg.keys import ACTION, GOAL_LATENT, LATENT, NEXT_LATENT, PIXELS, PREDICTED_LATENT

_MARKS = {NEXT_LATENT: "next", GOAL_LATENT: "goal"}  # parts of a key that mark these latents

Names = Mapping[str, Sequence[NestedKey]]


def feed(
    owner: str,
    module: TensorDictModuleBase,
    inputs: Mapping[str, torch.Tensor],
    names: Names | None = None,
    batch_size: Iterable[int] = (),
) -> TensorDict:
    """Builds the tensordict that a module reads its inputs from; :func:`arrange` says which key gets which tensor.

    Args:
        owner (str): name of the module in errors, such as ``"predictor"``.
        module (TensorDictModuleBase): the module.
        inputs (mapping of str to Tensor): tensors by contract name, in the order of positions.
        names (mapping of str to sequence of NestedKey, optional): further names of each input. Default: none.
        batch_size (iterable of int, optional): of the tensordict. Default: ``()``.

    Raises:
        ValueError: see :func:`arrange`.
    """
    names = {role: (names or {}).get(role, ()) for role in inputs}
    roles = arrange(owner, module.in_keys, names, keyword_arguments(module))
    return TensorDict({key: inputs[role] for key, role in zip(module.in_keys, roles)}, batch_size)


def arrange(
    owner: str, in_keys: Sequence[NestedKey], names: Names, arguments: Sequence[str] | None = None
) -> list[str]:
    """Assigns an input to each ``in_key`` of a network.

    A key is matched to an input by the first of these that applies: one of the input's further names, its contract name,
    the last part of either in a nested key, the keyword argument that the key is passed to. A key with a part ``"next"``
    or a last part ``"next_*"`` or ``"*_next"`` is the latent after a transition, and likewise for ``"goal"``. A key
    without a match gets the remaining input; if no key has a match, position decides.

    Args:
        owner (str): name of the network in errors.
        in_keys (sequence of NestedKey): of the network.
        names (mapping of str to sequence of NestedKey): further names of each input by its contract name, in the order of
            positions.
        arguments (sequence of str, optional): keyword argument of each ``in_key``. Default: none.

    Returns:
        contract names, one for each of ``in_keys``.

    Raises:
        ValueError: another number of keys than inputs, or names that contradict each other.

    Examples:
        >>> arrange("predictor", ["action", ("agent", "latent")], {"latent": (), "action": ()})
        ['action', 'latent']
        >>> arrange("predictor", ["a", "b"], {"latent": (), "action": ()})
        ['latent', 'action']
    """
    keys = [_parts(key) for key in in_keys]
    if len(keys) != len(names):
        raise ValueError(
            f"the {owner} must read {len(names)} entries ({', '.join(names)}), it reads {list(in_keys)}: wrap it accordingly."
        )
    if len(keys) == 1:
        return list(names)
    if len(keys) != len(set(keys)):
        raise _contradiction(owner, in_keys, names)
    claims = [_claims(key, names) for key in keys]
    if not any(claims) and arguments:
        claims = [_claims((name,), names) for name in arguments]
    claimed = [role for roles in claims for role in roles]
    left = iter([role for role in names if role not in claimed])
    foreign = [key for key, roles in zip(keys, claims) if not roles and key[-1] in (PIXELS, ACTION, LATENT)]
    if foreign or len(claimed) != len(set(claimed)) or max(map(len, claims)) > 1:
        raise _contradiction(owner, in_keys, names)
    roles = [roles[0] if roles else next(left) for roles in claims]
    if claimed == [LATENT] and roles[0] != LATENT and not _MARKS.keys().isdisjoint(names):
        raise _contradiction(owner, in_keys, names)  # ("x", "latent"): "x" may be either of two latents
    return roles


def sort_keys(owner: str, in_keys: Sequence[NestedKey], *roles: str) -> list[NestedKey]:
    """Sorts ``in_keys`` into the order ``roles`` in which a network takes its inputs."""
    arranged = arrange(owner, in_keys, dict.fromkeys(roles, ()))
    return [in_keys[arranged.index(role)] for role in roles]


def _contradiction(owner: str, in_keys: Sequence[NestedKey], names: Names) -> ValueError:
    return ValueError(
        f"the {owner} gets {' and '.join(names)}, and its in_keys {list(in_keys)} do not say which is which: name them "
        f"{list(names)}, or as in loss.set_keys(...)."
    )


def _claims(key: tuple[str, ...], names: Names) -> list[str]:
    """Inputs that match a key by the first rule that matches any."""
    marked = [role for role, mark in _MARKS.items() if role in names and _has(key, mark)]
    if marked:
        return marked
    own = {role: [_parts(name) for name in given] for role, given in names.items()}
    contract = {role: [(PREDICTED_LATENT if role == NEXT_LATENT else role,)] for role in names}
    for known in (own, contract):
        found = [role for role, given in known.items() if key in given]
        if found:
            return found
    for known in (own, contract):
        found = [
            role
            for role, given in known.items()
            if any(key[-1] == name[-1] and _has(key, "next") == _has(name, "next") for name in given)
        ]
        if found:
            return found
    return []


def _has(key: tuple[str, ...], mark: str) -> bool:
    return mark in key or key[-1].startswith(f"{mark}_") or key[-1].endswith(f"_{mark}")


def _parts(key: NestedKey) -> tuple[str, ...]:
    key = unravel_key(key)
    return (key,) if isinstance(key, str) else key


def require_tensordict(owner: str, value: object) -> None:
    """Checks that a module got a tensordict.

    Raises:
        TypeError: anything else, such as a dict.
    """
    if not is_tensor_collection(value):
        raise TypeError(
            f"{owner} takes a TensorDict, got a {type(value).__name__}: wrap a dict of tensors as TensorDict(batch, "
            "batch_size=[N])."
        )


def require_module(owner: str, value: object) -> None:
    """Checks that a network is a TensorDictModule.

    Raises:
        TypeError: anything else, such as a plain ``nn.Module``.
    """
    if not (callable(value) and hasattr(value, "in_keys") and hasattr(value, "out_keys")):
        raise TypeError(
            f"the {owner} must be a TensorDictModule, got a {type(value).__name__}: wrap a network as "
            "TensorDictModule(network, in_keys=[...], out_keys=[...])."
        )


def choose_output(module: TensorDictModuleBase, *keys: NestedKey) -> NestedKey | None:
    """Which of a module's ``out_keys`` is meant: its only one, or that of the first of ``keys`` it writes; None if none is."""
    if len(module.out_keys) == 1:
        return module.out_keys[0]
    written = {_parts(name): name for name in module.out_keys}
    for key in map(_parts, keys):
        ends = [name for parts, name in written.items() if parts[-1] == key[-1]]
        if key in written or len(ends) == 1:
            return written.get(key, ends[0])
    return None


def read_output(module: TensorDictModuleBase, written: TensorDictBase, *keys: NestedKey) -> torch.Tensor:
    """Reads the entry of :func:`choose_output`.

    Raises:
        KeyError: the module wrote several, and none has one of these names.
    """
    chosen = choose_output(module, *keys)
    if chosen is None:
        raise KeyError(
            f"no {keys[0]!r} among {module.out_keys}, what the network writes: see set_keys(...), or select the right one "
            "with selected_out_keys of a TensorDictSequential."
        )
    return written.get(chosen)
