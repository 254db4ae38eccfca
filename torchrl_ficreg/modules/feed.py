"""Networks are fed by the names of their keys, and by position only where no name says which tensor is meant."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import torch
from tensordict import is_tensor_collection, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key

from torchrl_ficreg.keys import ACTION, GOAL_LATENT, LATENT, PIXELS, PREDICTED_LATENT

NEXT_LATENT = "next_latent"  # contract name of the latent a transition leads to; ("next", "latent") is the same
_MARKS = {NEXT_LATENT: "next", GOAL_LATENT: "goal"}  # what tells the key of such a latent from that of another one

Names = Mapping[str, Sequence[NestedKey]]


def feed(
    owner: str,
    module: TensorDictModuleBase,
    inputs: Mapping[str, torch.Tensor],
    names: Names | None = None,
    batch_size: Iterable[int] = (),
) -> TensorDict:
    """The tensordict that a module reads its inputs from; see :func:`arrange` for which key gets which tensor.

    Args:
        owner: what the module is called in an error, such as ``"predictor"``.
        module: any TensorDictModule.
        inputs: tensors by contract name, in the order of positions.
        names: further names of each input.
        batch_size: of the tensordict.

    Raises:
        ValueError: see :func:`arrange`.
    """
    names = {role: (names or {}).get(role, ()) for role in inputs}
    roles = arrange(owner, module.in_keys, names, getattr(module, "_kwargs", None))
    return TensorDict({key: inputs[role] for key, role in zip(module.in_keys, roles)}, batch_size)


def arrange(
    owner: str, in_keys: Sequence[NestedKey], names: Names, arguments: Sequence[str] | None = None
) -> list[str]:
    """Which input each ``in_key`` of a network gets.

    A key belongs to an input by, in this order: one of its further names, its contract name, the last part of either in
    a nested key, and the keyword argument that the key is passed to. A key with a part ``"next"`` or a last part
    ``"next_*"`` or ``"*_next"`` is the latent a transition leads to, and so for ``"goal"``. A key that no name claims gets
    the input that is left; where no key is claimed, position decides.

    Args:
        owner: what the network is called in an error.
        in_keys: of the network.
        names: further names of each input by its contract name, in the order of positions.
        arguments: keyword argument of each ``in_key``, where the network has some.

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
        raise _contradiction(owner, in_keys, names)  # ("x", "latent"): which of two latents the first one is, is not said
    return roles


def sort_keys(owner: str, in_keys: Sequence[NestedKey], *roles: str) -> list[NestedKey]:
    """``in_keys`` in the order of the inputs of a network, named in ``roles``, that takes them by position."""
    arranged = arrange(owner, in_keys, dict.fromkeys(roles, ()))
    return [in_keys[arranged.index(role)] for role in roles]


def _contradiction(owner: str, in_keys: Sequence[NestedKey], names: Names) -> ValueError:
    return ValueError(
        f"the {owner} gets {' and '.join(names)}, and its in_keys {list(in_keys)} do not say which is which: name them "
        f"{list(names)}, or as in loss.set_keys(...)."
    )


def _claims(key: tuple[str, ...], names: Names) -> list[str]:
    """Inputs that the strongest rule which finds any finds for a key."""
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
    """Refuses what is no tensordict, at the door of a module.

    Raises:
        TypeError: a dict, or anything else.
    """
    if not is_tensor_collection(value):
        raise TypeError(
            f"{owner} takes a TensorDict, got a {type(value).__name__}: wrap a dict of tensors as TensorDict(batch, "
            "batch_size=[N])."
        )


def require_module(owner: str, value: object) -> None:
    """Refuses what does not say which entries it reads and writes, at the door of a loss, a model or a cost.

    Raises:
        TypeError: a plain ``nn.Module``, or anything else.
    """
    if not (callable(value) and hasattr(value, "in_keys") and hasattr(value, "out_keys")):
        raise TypeError(
            f"the {owner} must be a TensorDictModule, got a {type(value).__name__}: wrap a network as "
            "TensorDictModule(network, in_keys=[...], out_keys=[...])."
        )


def choose_output(module: TensorDictModuleBase, key: NestedKey) -> NestedKey | None:
    """The entry ``key`` among what a module writes, or its only one, whatever that is called; None where there is none."""
    if len(module.out_keys) == 1:
        return module.out_keys[0]
    key = _parts(key)
    written = {_parts(name): name for name in module.out_keys}
    ends = [name for parts, name in written.items() if parts[-1] == key[-1]]
    return written.get(key, ends[0] if len(ends) == 1 else None)


def read_output(module: TensorDictModuleBase, written: TensorDictBase, key: NestedKey, default: int) -> torch.Tensor:
    """The entry of :func:`choose_output`, or the one at the position ``default`` of ``out_keys``."""
    chosen = choose_output(module, key)
    return written.get(module.out_keys[default] if chosen is None else chosen)
