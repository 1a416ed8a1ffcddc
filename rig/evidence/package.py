"""Sealed packages of runs: a folder or zip with a manifest of SHA-256 sums, and its verification.

The manifest has the format of sha256sum, so `sha256sum -c MANIFEST.sha256` checks a folder without this program. A zip
is written without compression and without dates: the same files give the same bytes, and every byte can be verified.
"""

import contextlib
import hashlib
import io
import re
import shutil
import subprocess
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path, PurePosixPath
from typing import IO, NamedTuple

from fdi.output import write_whole
from fdi.progress import Progress
from plant import InputError, report_system_error, require, show_value

MANIFEST, INDEX = "MANIFEST.sha256", "evidence.json"
Files = Mapping[str, Callable[[], IO[bytes]]]  # name -> opens its content
_DAMAGE = (OSError, EOFError, RuntimeError, NotImplementedError, zipfile.BadZipFile, zlib.error)


class Signer(NamedTuple):
    """A program that signs: the file of its signature, and its arguments to sign and to verify."""

    file: str
    sign: str
    verify: str


SIGNERS = {
    "minisign": Signer(f"{MANIFEST}.minisig", "-S -s {key} -m {manifest} -x {signature}",
                       "-V -p {key} -m {manifest} -x {signature}"),
    "gpg": Signer(f"{MANIFEST}.asc",
                  "--batch --yes --local-user {key} --armor --output {signature} --detach-sign {manifest}",
                  "--batch --status-fd 1 --verify {signature} {manifest}"),
}


class Verification(NamedTuple):
    """What a package holds against its manifest. `seal`: SHA-256 of the manifest, which names the whole package."""

    files: int
    seal: str
    signature: str  # in words
    changed: list[str]
    missing: list[str]
    added: list[str]

    @property
    def is_intact(self) -> bool:
        """Whether nothing was changed, removed or added."""
        return not (self.changed or self.missing or self.added)


def open_content(content: bytes | Path) -> IO[bytes]:
    """Bytes, or a plain file, for reading. Raises OSError, also for a link."""
    if isinstance(content, bytes):
        return io.BytesIO(content)
    if content.is_symlink() or not content.is_file():
        raise OSError(f"{content} is no plain file")
    return content.open("rb")


def is_inside(name: str) -> bool:
    """Whether a name in a package or log stays below its folder."""
    path = PurePosixPath(name)
    return "\\" not in name and not path.is_absolute() and ".." not in path.parts and path.as_posix() == name != "."


def write_package(contents: Mapping[str, bytes | Path], out: Path, key: str, progress: Progress) -> str:
    """Write files with their manifest into a zip, or into a folder that is new or empty; return the seal.

    `key`: signs the manifest; "" for none.

    Raises:
        InputError: a place that cannot be written, a name that could leave the folder, a key that does not sign.
    """
    files = {name: partial(open_content, content) for name, content in contents.items()}
    hashes = {}
    for number, name in enumerate(sorted(files)):
        require(is_inside(name) and name.isprintable(), out, "",
                f"files whose names stay in the folder, not {show_value(name)}")
        hashes[name] = _compute_sha256(files[name])
        require(hashes[name], name, "", "a file that can be read")
        progress("sealing", 0.5 * number / len(files))
    manifest = _format_manifest(hashes)
    files[MANIFEST] = partial(open_content, manifest)
    if key:
        file, signature = _sign(manifest, key)
        files[file] = partial(open_content, signature)
    with report_system_error("--out", str(out), "a place that can be written"):
        out.parent.mkdir(parents=True, exist_ok=True)
        with write_whole(out) as part:
            if out.suffix == ".zip":
                with part.open("wb") as handle:
                    _write_zip(files, handle.write)
            for name, open_file in files.items() if out.suffix != ".zip" else ():
                (part / name).parent.mkdir(parents=True, exist_ok=True)
                with open_file() as source, (part / name).open("xb") as target:
                    shutil.copyfileobj(source, target)
    return hashlib.sha256(manifest).hexdigest()


def verify_package(path: Path, key: str = "") -> Verification:
    """Compare every byte of a package with its manifest; with `key`, demand a signature by it.

    Raises:
        InputError: no package, or a name in it that leads out of its folder.
    """
    with contextlib.ExitStack() as stack:
        files: dict[str, Callable[[], IO[bytes]]] = {}
        start = _read(partial(open_content, path), 1024)
        if path.is_dir():
            files = {each.relative_to(path).as_posix(): partial(open_content, each) for each in path.rglob("*")
                     if each.is_symlink() or not each.is_dir()}
        else:
            try:
                archive = stack.enter_context(zipfile.ZipFile(path))
                files = {name: partial(archive.open, name) for name in archive.namelist() if name[-1:] != "/"}
            except (*_DAMAGE, ValueError) as error:
                if start.startswith(b"PK"):
                    return Verification(0, "", "not checked", [f"{path.name} (damaged: {error})"], [], [])
                raise InputError(path, "", "a folder or zip that rig evidence made") from error
        if MANIFEST not in files:
            if INDEX in files or MANIFEST.encode() in start:  # the first file of a zip, whose directory is damaged
                return Verification(0, "", "not checked", [], [MANIFEST], [])
            raise InputError(path, MANIFEST, "a package of rig evidence, which has this file")
        verification = _compare_files(path, files, key)
        if not path.is_dir() and verification.is_intact and not _is_as_written(files, path):
            verification.changed.append(f"{path.name} (the zip itself; its files are as sealed)")
        return verification


def _read(open_file: Callable[[], IO[bytes]], most: int = -1) -> bytes:
    """The beginning of a file, or all of it; nothing of one that cannot be read."""
    with contextlib.suppress(*_DAMAGE), open_file() as handle:
        return handle.read(most)
    return b""


def _compare_files(path: Path, files: Files, key: str) -> Verification:
    manifest, hashes = _read(files[MANIFEST]), {}
    for number, line in enumerate(manifest.decode("utf-8", "replace").split("\n"), 1):
        if (entry := re.fullmatch(r"([0-9a-f]{64})  (.+)", line)) is not None:
            hashes[entry[2]] = entry[1]
            require(is_inside(entry[2]), f"{path}: {MANIFEST}:{number}", "",
                    f"a file of the package, not {entry[2][:200]!r}")
    for name in files:
        require(is_inside(name), path, "", f"names that stay in the package, not {show_value(name)}")
    changed_names = [] if _format_manifest(hashes) == manifest else [MANIFEST]
    changed_names += [name for name in sorted(hashes.keys() & files) if _compute_sha256(files[name]) != hashes[name]]
    missing_names = sorted(hashes.keys() - files)
    signature, tools = "none", [tool for tool, signer in SIGNERS.items() if signer.file in files]
    for tool in tools:
        file = SIGNERS[tool].file
        is_valid, signature = _check_signature(manifest, tool, _read(files[file]), key)
        changed_names += [] if is_valid else [f"{file} ({signature})"]
    missing_names += [f"a signature by {key}"] if key and not tools else []
    added_names = sorted(files.keys() - hashes.keys() - {MANIFEST, *(SIGNERS[tool].file for tool in tools)})
    return Verification(len(hashes), hashlib.sha256(manifest).hexdigest(), signature, changed_names, missing_names,
                        added_names)


def _format_manifest(hashes: Mapping[str, str]) -> bytes:
    return "".join(f"{hashes[name]}  {name}\n" for name in sorted(hashes)).encode("utf-8", "replace")


def _compute_sha256(open_file: Callable[[], IO[bytes]]) -> str:
    """The sum of a file, "" for one that cannot be read."""
    with contextlib.suppress(*_DAMAGE), open_file() as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()  # type: ignore[arg-type]
    return ""


class _Stream:
    """A file that cannot seek, so that a zip is written from front to back."""

    def __init__(self, write: Callable[[bytes], int]) -> None:
        self.write = write

    def flush(self) -> None:
        """Nothing is held back."""


def _write_zip(files: Files, write: Callable[[bytes], int]) -> None:
    """Write the zip of files piece by piece; the same files give the same bytes."""
    with zipfile.ZipFile(_Stream(write), "w") as archive:  # type: ignore[call-overload]
        for name in sorted(files):
            info = zipfile.ZipInfo(name)  # of 1980
            info.external_attr, info.create_system = 0o644 << 16, 3
            with files[name]() as source, archive.open(info, "w", force_zip64=True) as target:
                shutil.copyfileobj(source, target)


def _is_as_written(files: Files, path: Path) -> bool:
    """Whether a zip has the bytes that its files give, and no others."""
    with path.open("rb") as handle:
        differs: list[bool] = []

        def compare(data: bytes) -> int:
            if handle.read(len(data)) != bytes(data):
                differs.append(True)
            return len(data)

        _write_zip(files, compare)
        return not differs and not handle.read(1)


# ---------------------------------------------------------------------------------------------------------------------
# Signatures, by minisign or GPG
# ---------------------------------------------------------------------------------------------------------------------

def _sign(manifest: bytes, key: str) -> tuple[str, bytes]:
    """Name and content of the signature. Raises InputError for a key, or a program, that is not there."""
    tool = "minisign" if Path(key).is_file() else "gpg"
    answer, signature = _call(tool, SIGNERS[tool].sign, key, manifest, b"")
    require(signature, "--sign", key, f"a key with which {tool} signs{_describe_absence(answer)}")
    return SIGNERS[tool].file, signature


def _check_signature(manifest: bytes, tool: str, signature: bytes, key: str) -> tuple[bool, str]:
    """Whether nothing speaks against a signature, and in words what is known of it."""
    if tool == "minisign" and not key:
        return True, "by minisign, not checked: --key names the public key"
    answer, _ = _call(tool, SIGNERS[tool].verify, key, manifest, signature)
    if not key and (answer is None or "NO_PUBKEY" in answer.stdout):
        return True, f"not checked{_describe_absence(answer) or ': GPG does not have the public key'}"
    if answer is None:
        raise InputError("--key", key, f"a key of {tool}{_describe_absence(answer)}")
    signers = re.findall(r"VALIDSIG (\w+).*?(\w+)$", answer.stdout, re.MULTILINE)  # of the key, and of its primary key
    is_own = tool == "minisign" or any(each.endswith(key.replace(" ", "").upper()) for pair in signers for each in pair)
    is_valid = answer.returncode == 0 and is_own
    return is_valid, f"valid, by {key or signers[0][-1]}" if is_valid else f"not a valid signature by {key or 'a key'}"


def _describe_absence(answer: object) -> str:
    return ", but this program is not installed" if answer is None else ""


def _call(tool: str, arguments: str, key: str, manifest: bytes,
          signature: bytes) -> tuple[subprocess.CompletedProcess[str] | None, bytes]:
    """What a program says, None if it is not installed, and the signature then; without one before, it is to sign."""
    with tempfile.TemporaryDirectory() as name:
        places = {"key": key, "manifest": f"{name}/{MANIFEST}", "signature": f"{name}/{SIGNERS[tool].file}"}
        for file, content in (("manifest", manifest), ("signature", signature)):
            if content:
                Path(places[file]).write_bytes(content)
        output = subprocess.PIPE if signature else 2  # it may ask for a passphrase
        try:
            answer = subprocess.run([tool, *(word.format(**places) for word in arguments.split())], stdout=output,
                                    stderr=subprocess.PIPE, text=True, check=False)
        except FileNotFoundError:
            return None, b""
        signature_file = Path(places["signature"])
        return answer, signature_file.read_bytes() if signature_file.is_file() else b""
