"""Reads the weights of a policy from a file of Stable-Baselines3, and nothing else: no pickle of it can run code."""

from __future__ import annotations

import io
import pickletools
import zipfile
import zlib
from pathlib import Path
from typing import Any

import torch

from gym_mara.files import DamagedFileError, read_bytes

LARGEST = 2**26
"""The largest size of a model's file, and of all that is in it, bytes."""
_MOST_MEMBERS = 1000
# What torch.save writes for a dict of tensors.
_TENSORS = {
    "collections OrderedDict",
    "torch._utils _rebuild_tensor_v2",
    "torch._utils _rebuild_parameter",
    "torch FloatStorage",
    "torch DoubleStorage",
}
_IMPORTS = {"GLOBAL", "INST", "STACK_GLOBAL", "EXT1", "EXT2", "EXT4"}


def read_weights(file: Path, member: str = "policy.pth") -> dict[str, torch.Tensor]:
    """The weights of the policy in a model.zip, by name, or the tensors in another member of it.

    Raises:
        DamagedFileError: the file is missing, damaged or too large, or holds anything but finite numbers.
    """
    members = _members(read_bytes(file, LARGEST), str(file))
    if member not in members:
        raise DamagedFileError(f"cannot read {str(file)!r}: it has no {member}")
    try:
        return _tensors(members[member], f"{member} of {file}")
    except DamagedFileError:
        raise
    except Exception as error:  # torch raises any exception
        raise DamagedFileError(f"cannot read the weights in {str(file)!r}: {error}") from error


def _members(content: bytes, name: str) -> dict[str, bytes]:
    """All members of a zip archive, their checksums verified.

    Raises:
        DamagedFileError: it is damaged, or holds too much.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            about = archive.infolist()
            if len(about) > _MOST_MEMBERS or sum(member.file_size for member in about) > LARGEST:
                raise DamagedFileError(
                    f"cannot read {name!r}: it holds more than {_MOST_MEMBERS} files or {LARGEST:,} bytes"
                )
            # `read` stops at the size that the directory declares.
            return {member.filename: archive.read(member) for member in about}
    except DamagedFileError:
        raise
    # A changed flag claims encryption (RuntimeError), or another compression (NotImplementedError, zlib.error, …).
    except (zipfile.BadZipFile, zlib.error, OSError, EOFError, ValueError, RuntimeError) as error:
        raise DamagedFileError(f"cannot read {name!r}: {error}") from error


def _tensors(content: bytes, name: str) -> dict[str, torch.Tensor]:
    """The tensors that torch.save has written.

    Raises:
        DamagedFileError: it holds anything else, or numbers that are not finite.
        Exception: torch cannot read it.
    """
    members = _members(content, name)
    for member in (member for member in members if member.endswith("data.pkl")):
        for code, argument, _ in pickletools.genops(members[member]):
            if code.name in _IMPORTS and argument not in _TENSORS:
                raise DamagedFileError(f"cannot read {name!r}: it holds more than weights")
    loaded: Any = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    if not isinstance(loaded, dict) or not all(
        isinstance(key, str) and type(value) is torch.Tensor and value.is_floating_point()
        for key, value in loaded.items()
    ):
        raise DamagedFileError(f"cannot read {name!r}: it holds more than weights")
    # A tensor may show few numbers many times, and so be larger than its file.
    if sum(value.numel() for value in loaded.values()) * 4 > LARGEST:
        raise DamagedFileError(f"cannot read {name!r}: it holds more than {LARGEST:,} bytes")
    if not all(bool(value.isfinite().all()) for value in loaded.values()):
        raise DamagedFileError(f"cannot read {name!r}: a weight is not finite")
    return loaded
