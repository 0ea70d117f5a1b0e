"""Picture files: opened by Pillow's readers of plain formats only, with the size checked first."""

from __future__ import annotations

import contextlib
import io
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from gsfluent.errors import InputError
from gsfluent.io.checked.files import regular_file
from gsfluent.io.checked.limits import within

if TYPE_CHECKING:
    from PIL import Image

# others are not photographs, and some (EPS) start programs
_FORMATS = ("JPEG", "PNG", "WEBP", "BMP", "DIB", "TIFF")


def check_pixels(width: int, height: int, where: object) -> None:
    """Raise unless a picture of this size may be decoded.

    Raises:
        InputError: It is above the limit ``pixels``.
    """
    within("pixels", int(width) * int(height), where)


@contextlib.contextmanager
def opened_image(
    path: str | Path,
    hint: str = "convert it to PNG or JPEG",
    *,
    noun: str = "image",
    missing: str = "check the path",
    data: bytes | None = None,
) -> Iterator[Image.Image]:
    """An image, not yet decoded; whatever is wrong with it inside the block names the file.

    Args:
        path: The file.
        hint: What to do when it is damaged or of another format.
        noun: What it should be.
        missing: What to do when it is not there.
        data: The picture itself, where ``path`` is only its name in an archive.

    Raises:
        InputError: Missing, empty, damaged, of another format, or above the limit ``pixels``.
    """
    from PIL import Image, UnidentifiedImageError

    size = regular_file(path, noun, missing) if data is None else len(data)
    if size == 0:
        raise InputError(f"{path}: the file is empty", "export it again")
    try:
        source = path if data is None else io.BytesIO(data)
        with Image.open(source, formats=_FORMATS) as image:
            check_pixels(*image.size, path)
            yield image
    except InputError:
        raise
    except MemoryError as error:
        raise InputError(
            f"{path}: the {noun} is damaged or asks for more memory than there is", hint
        ) from error
    except UnidentifiedImageError as error:
        raise InputError(f"{path}: not an image that Pillow can read", hint) from error
    except Image.DecompressionBombError as error:
        raise InputError(
            f"{path}: the {noun} is far above the limit of pixels ({error})",
            "if the file is to be trusted, make it smaller",
        ) from error
    except (
        OSError, ValueError, SyntaxError, LookupError, TypeError, ArithmeticError, EOFError,
        AttributeError, RuntimeError, struct.error,
    ) as error:  # fmt: skip
        raise InputError(
            f"{path}: the {noun} is damaged ({type(error).__name__}: {error})", hint
        ) from error
