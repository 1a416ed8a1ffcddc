"""Chapter 1: the EDS agrees with CiA 306, with CiA 301 and with itself. Nothing is sent."""

import re
from itertools import combinations

from canopen.objectdictionary.datatypes import DATA_TYPES, UNSIGNED8, UNSIGNED16, UNSIGNED32, VISIBLE_STRING

from rig.benches import INVALID, PARAMETERS, Pdo
from rig.conformance.pdo_cases import describe_mapping, split_entry
from rig.conformance.target import (
    HISTORY,
    SIZES,
    Case,
    CaseFailed,
    Target,
    Variable,
    for_each,
    is_restricted,
    join_labels,
    require,
)

SECTIONS = {"FileInfo": (), "MandatoryObjects": (),
            "DeviceInfo": ("VendorName", "VendorNumber", "ProductName", "ProductNumber", "RevisionNumber",
                           "Granularity", "NrOfRXPDO", "NrOfTXPDO")}
LISTS = {"MandatoryObjects": range(0x1000, 0x1019), "OptionalObjects": range(0x1000, 0x10000),
         "ManufacturerObjects": range(0x2000, 0x6000)}  # list -> objects that may be in it
TYPES = (*SIZES, *DATA_TYPES)
# Data type and access of objects of the communication profile, CiA 301, 7.5.2.
STANDARD = {
    (0x1000, 0): (UNSIGNED32, "ro const"), (0x1001, 0): (UNSIGNED8, "ro"), (0x1002, 0): (UNSIGNED32, "ro"),
    (0x1003, 0): (UNSIGNED8, "rw"), (0x1003, 1): (UNSIGNED32, "ro"), (0x1005, 0): (UNSIGNED32, "rw const ro"),
    (0x1006, 0): (UNSIGNED32, "rw const ro"), (0x1007, 0): (UNSIGNED32, "rw const ro"),
    (0x1008, 0): (VISIBLE_STRING, "const ro"), (0x1009, 0): (VISIBLE_STRING, "const ro"),
    (0x100A, 0): (VISIBLE_STRING, "const ro"), (0x100C, 0): (UNSIGNED16, "rw ro const"),
    (0x100D, 0): (UNSIGNED8, "rw ro const"), (0x1010, 1): (UNSIGNED32, "rw"), (0x1011, 1): (UNSIGNED32, "rw"),
    (0x1014, 0): (UNSIGNED32, "rw const ro"), (0x1015, 0): (UNSIGNED16, "rw const ro"),
    (0x1016, 1): (UNSIGNED32, "rw const ro"), (0x1017, 0): (UNSIGNED16, "rw const ro"),
    (0x1018, 1): (UNSIGNED32, "ro const"), (0x1018, 2): (UNSIGNED32, "ro const"),
    (0x1018, 3): (UNSIGNED32, "ro const"), (0x1018, 4): (UNSIGNED32, "ro const"),
    (0x1019, 0): (UNSIGNED8, "rw const ro"), (0x1029, 1): (UNSIGNED8, "rw const ro"),
    (0x1200, 1): (UNSIGNED32, "ro const"), (0x1200, 2): (UNSIGNED32, "ro const"),
}  # fmt: skip
PDO_TYPES = {1: UNSIGNED32, 2: UNSIGNED8, 3: UNSIGNED16, 4: UNSIGNED8, 5: UNSIGNED16, 6: UNSIGNED8}


def check_sections(t: Target) -> str:
    """The sections and keys that every EDS has."""
    text = t.sheet.text
    for section, keys in SECTIONS.items():
        require(text.has_section(section), f"no section {section}")
        missing = [key for key in keys if not text.has_option(section, key)]
        require(not missing, f"{section} has no {join_labels(missing)}")
    rates = [key[9:] for key in text.options("DeviceInfo") if key.startswith("BaudRate_")
             and read_number(t, "DeviceInfo", key) == 1]
    require(rates, "DeviceInfo names no bit rate")
    return f"{len(text.sections())} sections; bit rates {', '.join(rates)} kbit/s"


def check_mandatory_objects(t: Target) -> str:
    """CiA 301 asks every node for three objects."""
    missing = [f"0x{index:04X}:{sub}" for index, sub in ((0x1000, 0), (0x1001, 0), (0x1018, 0), (0x1018, 1))
               if t.sheet.find(index, sub) is None]
    require(not missing, f"missing: {join_labels(missing)}")
    return f"all there, of {len(t.sheet.objects)} objects"


def check_lists(t: Target) -> str:
    """The three lists name exactly the objects that are described."""
    listed_indices: list[int] = []
    problems = []
    for name, permitted in LISTS.items():
        keys = t.sheet.text.options(name) if t.sheet.text.has_section(name) else []
        entries = [read_number(t, name, key) for key in keys if key.isdigit()]
        if (count := read_number(t, name, "SupportedObjects")) != len(entries):
            problems.append(f"{name} says {count} and lists {len(entries)}")
        problems += [f"0x{index:04X} in {name}" for index in entries if index not in permitted]
        listed_indices += entries
    described_indices = {int(section, 16) for section in list_described(t)}
    problems += [
        *(f"0x{index:04X} is listed twice" for index in sorted(set(listed_indices)) if listed_indices.count(index) > 1),
        *(f"0x{index:04X} is listed and not described" for index in sorted(set(listed_indices) - described_indices)),
        *(f"0x{index:04X} is described and not listed" for index in sorted(described_indices - set(listed_indices)))]
    require(not problems, join_labels(problems))
    return f"{len(listed_indices)} objects in the lists"


def list_arrays(t: Target) -> list[int]:
    """The arrays and records whose sub-indices have a section each."""
    return [index for index in t.sheet.objects if read_number(t, f"{index:04X}", "ObjectType", 7) in (8, 9)
            and not read_number(t, f"{index:04X}", "CompactSubObj")]


def check_subindices(t: Target, index: int) -> None:
    """Arrays and records say how many sub-indices they have, in two places."""
    variables = t.sheet.objects[index]
    sub_number, subs = read_number(t, f"{index:04X}", "SubNumber", -1), [variable.sub for variable in variables]
    require(sub_number == len(subs), f"0x{index:04X} says SubNumber {sub_number} and has {len(subs)}")
    require(0 in subs, f"0x{index:04X} has no sub 0")
    highest = t.sheet.default(index)
    counts_used = index == HISTORY or variables[0].is_mapping  # sub 0 counts what is in use
    is_right = highest == subs[-1] or (counts_used and (highest is None or highest <= subs[-1]))
    require(is_right and variables[0].data_type == UNSIGNED8,
            f"0x{index:04X}:0 is {highest}, the highest sub-index is {subs[-1]}")


def check_types(t: Target) -> str:
    """Objects and variables are described with values that CiA 306 knows."""
    unknown = [f"[{section}] has an unknown ObjectType" for section in list_described(t)
               if read_number(t, section, "ObjectType", 7) not in (0, 2, 5, 6, 7, 8, 9)]
    require(not unknown, join_labels(unknown))
    return for_each(lambda t: t.sheet.variables, check_type, "variable")(t)


def check_type(t: Target, variable: Variable) -> None:
    """A variable has a type, an access and a default that is possible."""
    default = variable.default
    require(variable.data_type in TYPES, f"{variable.label} has DataType 0x{variable.data_type:04X}")
    is_known = variable.access in ("ro", "wo", "rw", "rwr", "rww", "const")
    require(is_known, f"{variable.label} has AccessType {variable.access!r}")
    if variable.size and isinstance(default, int | float):
        require(variable.can_hold(default), f"{variable.label}: {default} does not fit its type")
        require(variable.is_inside(default), f"{variable.label}: {default} is outside its limits")


def find_standard(variable: Variable) -> tuple[int, str]:
    """Type and access that CiA 301 gives this variable, (0, "") if it gives none."""
    index, sub = variable.key
    if index in PARAMETERS and sub in PDO_TYPES:
        return PDO_TYPES[sub], "rw ro const"
    if variable.is_mapping:
        return (UNSIGNED32 if sub else UNSIGNED8), "rw ro const"
    return STANDARD.get((index, min(sub, 1) if index in (0x1003, 0x1016) else sub), (0, ""))


def check_standard(t: Target, variable: Variable) -> None:
    """An object whose type and access CiA 301 gives."""
    data_type, access = find_standard(variable)
    require(variable.data_type == data_type,
            f"{variable.label} has DataType 0x{variable.data_type:04X}, expected 0x{data_type:04X}")
    require(variable.access in access.split(),
            f"{variable.label} is {variable.access}, expected {access.replace(' ', ' or ')}")


def check_pdo_parameters(t: Target) -> str:
    """Communication and mapping parameters come in pairs."""
    pdos = t.sheet.pdos
    mappings = {pdo.mapping for pdo in pdos}
    counts = [(key, read_number(t, "DeviceInfo", key, -1), sum(pdo.is_received is is_received for pdo in pdos))
              for key, is_received in (("NrOfRXPDO", True), ("NrOfTXPDO", False))]
    problems = [
        *(f"{pdo.name} has no 0x{pdo.parameter:04X}:{sub}" for pdo in pdos for sub in (0, 1, 2)
          if t.sheet.find(pdo.parameter, sub) is None),
        *(f"{pdo.name} has no mapping 0x{pdo.mapping:04X}" for pdo in pdos if pdo.mapping not in t.sheet.objects),
        *(f"{variable.label} maps a PDO that is not there" for variable in t.sheet.variables
          if variable.is_mapping and variable.sub == 0 and variable.index not in mappings),
        *(f"{key} is {number}, {count} are described" for key, number, count in counts if number != count)]
    require(not problems, join_labels(problems))
    return f"{len(pdos)} PDOs"


def check_pdo_mapping(t: Target, pdo: Pdo) -> str:
    """The default mappings name objects that can be mapped."""
    subs = range(1, (t.sheet.default(pdo.mapping) or 0) + 1)
    words = [t.sheet.default(pdo.mapping, sub) or 0 for sub in subs]
    for variable in filter(None, (t.sheet.find(*split_entry(word)[:2]) for word in words)):
        can_be_carried = variable.is_writable if pdo.is_received else variable.is_readable
        require(can_be_carried and variable.is_mappable
                and variable.access != ("rwr" if pdo.is_received else "rww"),
                f"{pdo.name} maps {variable.label}, which is {variable.access} with PDOMapping="
                f"{variable.is_mappable:d}")
    return describe_mapping(t, pdo, words)


def check_identity(t: Target) -> str:
    """What identifies the product. The vendor-ID is given by CiA."""
    vendor = t.sheet.default(0x1018, 1)
    if not vendor:
        raise CaseFailed(f"the vendor-ID is {'not given' if vendor is None else vendor}, which is invalid")
    for sub, key in ((1, "VendorNumber"), (2, "ProductNumber"), (3, "RevisionNumber")):
        value, number = t.sheet.default(0x1018, sub), read_number(t, "DeviceInfo", key, -1)
        require(value in (None, number), f"0x1018:{sub} is 0x{value or 0:X}, {key} is "
                                         f"{f'0x{number:X}' if number >= 0 else 'not given'}")
    reserved = " (reserved by CiA: no vendor's)" if 0xAFFF0000 <= vendor <= 0xFFFEFFFF or vendor >= 0xFFFF1000 else ""
    return f"vendor-ID 0x{vendor:08X}{reserved}"


def check_identifiers(t: Target) -> str:
    """COB-IDs as they are after a reset."""
    words = [*((pdo.name, t.sheet.default(pdo.parameter, 1), not pdo.is_received) for pdo in t.sheet.pdos),
             ("SYNC", t.sheet.default(0x1005), False), ("EMCY", t.sheet.default(0x1014), True)]
    cob_ids = [(name, word & 0x7FF, is_sent) for name, word, is_sent in words
               if word is not None and (name == "SYNC" or not word & INVALID)]
    problems = [
        *(f"{name} uses 0x{can_id:03X}, which is restricted" for name, can_id, _ in cob_ids if is_restricted(can_id)),
        *(f"{second[0]} and {first[0]} send 0x{first[1]:03X}" for first, second in combinations(cob_ids, 2)
          if first[1:] == second[1:] and first[2])]
    require(not problems, join_labels(problems))
    return f"{len(cob_ids)} COB-IDs"


def list_described(t: Target) -> list[str]:
    """The sections that describe an object."""
    return [section for section in t.sheet.text.sections() if re.fullmatch("[0-9A-Fa-f]{4}", section)]


def read_number(t: Target, section: str, key: str, absent: int = 0) -> int:
    """A number in the file. Raises CaseFailed for one that cannot be read."""
    name = next((each for each in t.sheet.text.sections() if each.upper() == section.upper()), "")
    text = t.sheet.text.get(name, key, fallback="").strip()
    try:
        return int(text, 0) if text else absent
    except ValueError:
        raise CaseFailed(f"[{section}] {key}={text} is no number") from None


CASES = (
    Case("1.1", "sections of the file", "CiA 306",
         "FileInfo, DeviceInfo and MandatoryObjects are there; DeviceInfo has its keys", check_sections),
    Case("1.2", "mandatory objects", "7.5.2.1, 7.5.2.2, 7.5.2.21", "0x1000, 0x1001 and 0x1018 with sub 0 and 1",
         check_mandatory_objects),
    Case("1.3", "lists of objects", "CiA 306",
         "every object is in one list, every list entry has a section, the counts are right", check_lists),
    Case("1.4", "sub-indices", "7.4, CiA 306", "SubNumber is the number of sub-indices; sub 0 holds the highest one",
         for_each(list_arrays, check_subindices, "object", "{} with sub-indices")),
    Case("1.5", "types, access and limits", "7.4, CiA 306",
         "known ObjectType, DataType and AccessType; the default fits its type and its limits", check_types),
    Case("1.6", "communication profile", "7.5.2", "objects 0x1000 to 0x1FFF have the type and access of CiA 301",
         for_each(lambda t: [each for each in t.sheet.variables if find_standard(each)[0]], check_standard, "object",
                  "{} of the standard")),
    Case("1.7", "PDO parameters", "7.5.2.35 to 7.5.2.38",
         "each PDO has parameters and a mapping; DeviceInfo counts them",
         check_pdo_parameters),
    Case("1.8", "PDO mapping", "7.5.2.36, 7.5.2.38",
         "mapped objects exist, may be mapped in that direction, have that length; at most 64 bits",
         for_each(lambda t: t.sheet.pdos, check_pdo_mapping)),
    Case("1.9", "identity", "7.5.2.21",
         "the vendor-ID is not 0; DeviceInfo repeats vendor-ID, product code and revision of 0x1018", check_identity),
    Case("1.10", "COB-IDs", "7.3.3, 7.3.5",
         "no default uses a restricted identifier, and no two objects send under the same", check_identifiers),
)
