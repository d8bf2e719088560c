"""A zip file from a stranger, read in memory and with suspicion.

The one layout that is accepted is the plain one that `bundle.py` writes: members one directly
behind the other from the first byte, their directory, its end record, nothing else. So nothing can
hide before, between, behind or inside another member, and a member has one size, one name and one
meaning. Everything is checked before anything is decompressed, and decompression stops where the
header said that it would.
"""

from __future__ import annotations

import re
import stat
import struct
import zlib
from typing import NamedTuple

from coursekit.submission.contents import shown

MAX_FILE = 5 * 2**20  # bytes
MAX_MEMBERS = 32
MAX_TOTAL = 32 * 2**20  # bytes, of all members together
MAX_RATIO = 100  # of a member's size to what it takes up in the file

HAND_IN = "hand in the file that `coursekit submit` wrote, as it is"
COPY_AGAIN = "copy or download it again"
AS_IT_WAS = "hand in the .zip that `coursekit submit` wrote, never unpacked and never zipped again"
EXTRA = "carries a comment or extra fields, as when files are zipped again"

_END = struct.Struct("<4s4H2LH")
_ENTRY = struct.Struct("<4s6H3L5H2L")
_LOCAL = struct.Struct("<4s5H3L2H")
_FLAGS_WITHOUT_MEANING = 0x0806  # how hard deflate tried; that the name is UTF-8 (it is ASCII)
_STORED, _DEFLATED = 0, 8
_ARCHIVES = (".zip", ".gz", ".tgz", ".bz2", ".xz", ".zst", ".7z", ".rar", ".tar", ".jar", ".npz")


class Refused(ValueError):
    """A bundle that is not read. `reason`: a short code. The message: what is wrong, what to do."""

    def __init__(self, reason: str, wrong: str, cure: str = HAND_IN) -> None:
        super().__init__(reason, wrong, cure)  # all of it, so that it survives pickling
        self.reason = reason
        self.wrong = wrong
        self.cure = cure

    def __str__(self) -> str:
        return f"{self.wrong}; {self.cure}."


class Member(NamedTuple):
    """What the directory says of one member.

    packed, size: bytes, in the file and unpacked. offset: of its header in the file. extra,
    comment: bytes of them. attributes: of the file that it was, by its maker's system.
    """

    name: str
    flags: int
    method: int
    crc: int
    packed: int
    size: int
    offset: int
    extra: int
    comment: int
    disk: int
    attributes: int


class Archive:
    """The members of a zip file, by name; all headers are checked when it is made.

    allowed: the pattern of a permitted name, and the most bytes that such a member may have.
    Raises Refused.
    """

    def __init__(self, data: bytes, allowed: dict[re.Pattern[str], int]) -> None:
        start, count = _find_directory(data)
        members = _read_directory(data, start, count)
        for member in members:
            _check_name(member.name, allowed)
        for member in members:
            _check_entry(member)
        _check_sizes(members, allowed)
        self._data = data
        self._start = _check_layout(data, start, members)
        self.members = {member.name: member for member in members}

    def read(self, name: str) -> bytes:
        """The content of a member; Refused when there is none, or when it is damaged."""
        if name not in self.members:
            raise Refused("missing_member", f"{name} is missing from the bundle")
        member = self.members[name]
        start = self._start[name]
        content = _unpack(self._data[start : start + member.packed], member)
        if zlib.crc32(content) != member.crc:
            raise Refused("bad_checksum", f"{name} is damaged (its checksum is off)", COPY_AGAIN)
        return content


def _find_directory(data: bytes) -> tuple[int, int]:
    """Where the directory begins, and how many members it has; it must end where the file does."""
    _check_ends(data)
    end = len(data) - _END.size
    _, disk, first_disk, here, count, size, start, _ = _END.unpack_from(data, end)
    if 0xFFFF in (disk, here, count) or 0xFFFFFFFF in (size, start):
        raise Refused("zip64", "The file is a zip of the large kind (zip64)")
    if data[max(end - 20, 0) : end].startswith(b"PK\x06\x07"):
        raise Refused("zip64", "The file is a zip of the large kind (zip64)")
    if disk or first_disk or here != count:
        raise Refused("several_disks", "The file is one part of a zip that was split")
    if count > MAX_MEMBERS:
        raise Refused("too_many_members", f"The zip has {count} members, {MAX_MEMBERS} are allowed")
    if start + size != end:
        raise Refused("bad_directory", "The zip's directory is not where the zip says")
    return start, count


def _check_ends(data: bytes) -> None:
    """The file must begin with a member and end with the end record of a zip."""
    if not data:
        raise Refused("empty_file", "The file is empty", COPY_AGAIN)
    if len(data) > MAX_FILE:
        raise Refused("file_too_large", f"The file has {len(data)} bytes, {MAX_FILE} are allowed")
    if data.startswith(b"PK\x05\x06"):
        raise Refused("no_members", "The zip is empty")
    end = data.rfind(b"PK\x05\x06")
    if not data.startswith(b"PK\x03\x04"):
        if end < 0:
            raise Refused("not_a_zip", "The file is no zip")
        raise Refused("data_before", "Something was put before the zip's first member")
    if end < 0 or len(data) - end < _END.size:
        raise Refused("truncated", "The file is cut off: its end is missing", COPY_AGAIN)
    if len(data) - end > _END.size or data[-2:] != b"\0\0":
        raise Refused("data_behind", "Something was put behind the zip's end, or a comment into it")


def _read_directory(data: bytes, start: int, count: int) -> list[Member]:
    """The members in the directory that begins at `start`, all of different names."""
    end = len(data) - _END.size
    members: list[Member] = []
    names: set[str] = set()
    for _ in range(count):
        if start + _ENTRY.size > end or data[start : start + 4] != b"PK\x01\x02":
            raise Refused("bad_directory", "The zip's directory is damaged", COPY_AGAIN)
        fields = _ENTRY.unpack_from(data, start)
        flags, method, _, _, crc, packed, size, name_size, extra, comment, disk = fields[3:14]
        _, attributes, offset = fields[14:]
        start += _ENTRY.size
        name = data[start : start + name_size].decode("latin-1")  # any bytes; then only ASCII
        start += name_size + extra + comment
        if name in names:
            raise Refused("duplicate_member", f"{shown(name)} is in the zip twice")
        names.add(name)
        sizes = (crc, packed, size, offset, extra, comment)
        members.append(Member(name, flags, method, *sizes, disk, attributes))
    if start != end:
        raise Refused("bad_directory", "The zip's directory has members that it does not count")
    return members


def _check_name(name: str, allowed: dict[re.Pattern[str], int]) -> None:
    """Members have the names of the format; whatever is special about others is said."""
    if any(pattern.fullmatch(name) for pattern in allowed):
        return
    what = f"The zip has a member {shown(name)}"
    if name.startswith(("/", "\\")) or re.match("[A-Za-z]:", name):
        raise Refused("absolute_path", f"{what}, a path from the root of a disk")
    if ".." in re.split(r"[/\\]", name):
        raise Refused("path_traversal", f"{what}, a path that climbs out of its folder")
    if "\\" in name:
        raise Refused("backslash", f"{what}, a name with a backslash", AS_IT_WAS)
    if name.endswith("/"):
        raise Refused("folder", f"{what}, a folder: it was unpacked and zipped again", AS_IT_WAS)
    if _is_zipped_again(name, allowed):
        wrong = f"{what}: the bundle was unpacked and its files or their folder zipped again"
        raise Refused("zipped_again", wrong, AS_IT_WAS)
    if name.lower().endswith(_ARCHIVES):
        raise Refused("nested_archive", f"{what}, an archive in the archive", AS_IT_WAS)
    raise Refused("unknown_member", f"{what}, which a bundle does not have")


def _is_zipped_again(name: str, allowed: dict[re.Pattern[str], int]) -> bool:
    """Whether a member is one of a bundle in a folder, or what macOS adds when it makes a zip."""
    *folders, last = name.split("/")
    inside = bool(folders) and any(pattern.fullmatch(last) for pattern in allowed)
    return inside or folders[:1] == ["__MACOSX"] or last == ".DS_Store"


def _check_entry(member: Member) -> None:
    """A member is a plain file, stored or deflated, and its header has nothing up its sleeve."""
    name, kind = member.name, stat.S_IFMT(member.attributes >> 16)  # as Unix writes them
    if member.flags & 0x2041:
        raise Refused("encrypted", f"{name} is encrypted")
    if member.flags & 0x0008:
        wrong = f"The size of {name} is given behind it, not before, as when files are zipped again"
        raise Refused("data_descriptor", wrong, AS_IT_WAS)
    if member.flags & ~_FLAGS_WITHOUT_MEANING:
        raise Refused("unknown_flags", f"{name} has the unknown flags {member.flags:#06x}")
    if kind == stat.S_IFLNK:
        raise Refused("symlink", f"{name} is a link to another file")
    if kind not in (0, stat.S_IFREG) or member.attributes & 0x10:
        raise Refused("special_file", f"{name} is no plain file")
    if member.method not in (_STORED, _DEFLATED):
        method = f"method {member.method}"
        raise Refused("compression_method", f"{name} is compressed in an unknown way ({method})")
    if 0xFFFFFFFF in (member.packed, member.size, member.offset) or member.disk == 0xFFFF:
        raise Refused("zip64", f"{name} is stored in the large kind of zip (zip64)")
    if member.extra or member.comment:
        raise Refused("extra_field", f"{name} {EXTRA}", AS_IT_WAS)
    if member.disk:
        raise Refused("several_disks", f"{name} is in another part of a zip that was split")


def _check_sizes(members: list[Member], allowed: dict[re.Pattern[str], int]) -> None:
    """What the members declare to be is within the caps, one by one and all together."""
    total = sum(member.size for member in members)
    if total > MAX_TOTAL:
        raise Refused("too_large", f"Unpacked, it has {total} bytes, {MAX_TOTAL} are allowed")
    for member in members:
        name, size = member.name, member.size
        if size > MAX_RATIO * member.packed:
            raise Refused("zip_bomb", f"{name} unpacks to more than {MAX_RATIO} times its size")
        most = next(most for pattern, most in allowed.items() if pattern.fullmatch(name))
        if size > most:
            raise Refused("member_too_large", f"{name} has {size} bytes, {most} are allowed")
        if member.method == _STORED and member.packed != size:
            raise Refused("lying_header", f"{name} is stored as it is, yet has two sizes")


def _check_layout(data: bytes, end: int, members: list[Member]) -> dict[str, int]:
    """Where the members' contents begin; each must lie where the one before it ends."""
    contents, position = {}, 0
    for member in sorted(members, key=lambda member: member.offset):
        name = member.name
        if member.offset != position:
            what = "overlaps another" if member.offset < position else "leaves a gap before it"
            reason = "overlap" if member.offset < position else "data_between"
            raise Refused(reason, f"{name} {what} in the zip")
        _check_local(data, position, member)
        contents[name] = position + _LOCAL.size + len(name)
        position = contents[name] + member.packed
        if position > end:
            raise Refused("lying_header", f"{name} reaches into the zip's directory")
    if position != end:
        raise Refused("data_between", "Something was put between the members and the directory")
    return contents


def _check_local(data: bytes, position: int, member: Member) -> None:
    """The header in front of a member says what the directory says."""
    if len(data) - position < _LOCAL.size or data[position : position + 4] != b"PK\x03\x04":
        raise Refused("bad_header", f"{member.name} has no header", COPY_AGAIN)
    fields = _LOCAL.unpack_from(data, position)
    _, _, flags, method, _, _, crc, packed, size, name_size, extra = fields
    position += _LOCAL.size
    name = data[position : position + name_size].decode("latin-1")
    same = (name, flags, method, crc, packed, size)
    if same != member[:6]:
        raise Refused("lying_header", f"{member.name} has a header that the directory contradicts")
    if extra:
        raise Refused("extra_field", f"{member.name} {EXTRA}", AS_IT_WAS)


def _unpack(packed: bytes, member: Member) -> bytes:
    """A member's content, at most one byte more than declared: then it was a lie."""
    if member.method == _STORED:
        return packed
    inflate = zlib.decompressobj(-zlib.MAX_WBITS)
    try:
        content = inflate.decompress(packed, member.size + 1)
    except zlib.error:
        raise Refused("bad_compression", f"{member.name} is damaged", COPY_AGAIN) from None
    if len(content) > member.size or (inflate.eof and len(content) < member.size):
        raise Refused("lying_header", f"{member.name} is not as long as its header says")
    if not inflate.eof or inflate.unused_data:
        raise Refused("bad_compression", f"{member.name} is damaged", COPY_AGAIN)
    return content
