"""Units of another tool, sound or with a fault: foreign_fmu.c compiled, and a description."""

import subprocess
import zipfile
from pathlib import Path

import fmpy
import fmpy.fmi2
import fmpy.fmi3

SOURCE = Path(__file__).with_name("foreign_fmu.c")
_VARIABLES = (("u", "input", "continuous"), ("F", "input", "continuous"), ("slide.x", "output", "continuous"),
              ("k", "parameter", "tunable"), ("d", "parameter", "fixed"))


def build_fmu(path: Path, version: str = "3", does: str = "NOTHING", at: int = -1, unit: str = "",
              platform: str = "", kind: str = "CoSimulation", fmi: str = "", sources: bool = False,
              stubs: bool = True) -> Path:
    """Write a unit to `path`.

    Args:
        path: of the file.
        version: of FMI.
        does: what it does in step `at`: NOTHING, CRASH, HANG, REFUSE, GIVE_NAN, END; or EVENT_MODE, which it needs; or
            TOKEN, which it refuses; or DIVERGE, where k is above 4.
        at: number of the step.
        unit: more attributes of the interface.
        platform: folder of its library, where it is not that of this machine.
        kind: the interface that it offers.
        fmi: version that the description claims.
        sources: leave out the library; there is source code instead.
        stubs: all functions of the interface are there, also those that nobody calls.
    """
    library = path.with_suffix(".so")
    flags = [f"-DDOES={does}", f"-DSTEP_THAT={at}", *(["-DFMI3"] if version == "3" else [])]
    interface = {"2": fmpy.fmi2.FMU2Slave, "3": fmpy.fmi3.FMU3Slave}[version]
    stub_source = path.with_suffix(".c")
    stub_source.write_text("".join(f"int {name}(void) {{ return 3; }}\n" for name in dir(interface)
                                   if stubs and name.startswith(f"fmi{version}")
                                   and f"{name}(" not in SOURCE.read_text()))
    subprocess.run(["cc", "-shared", "-fPIC", "-w", "-o", library, *flags, SOURCE, stub_source], check=True)
    scalars = ""
    for i, (name, causality, variability) in enumerate(_VARIABLES, 1):
        start = "" if causality == "output" or name == "d" else ' start="0"'
        itself = f'name="{name}" valueReference="{i}" causality="{causality}" variability="{variability}"'
        scalars += (f"<Float64 {itself}{start}/>" if version == "3" else
                    f"<ScalarVariable {itself}><Real{start}/></ScalarVariable>")
    big = 'name="is_big" valueReference="6" causality="parameter" variability="fixed"'
    scalars += (f'<Boolean {big} start="false"/>' if version == "3" else
                f'<ScalarVariable {big}><Boolean start="false"/></ScalarVariable>')
    token = "instantiationToken" if version == "3" else "guid"
    outputs = '<Output valueReference="3"/>' if version == "3" else '<Outputs><Unknown index="3"/></Outputs>'
    text = (f'<fmiModelDescription fmiVersion="{fmi or version + ".0"}" modelName="slide" {token}="x"><{kind} '
            f'modelIdentifier="slide" {unit}/><ModelVariables>{scalars}</ModelVariables><ModelStructure>{outputs}'
            "</ModelStructure></fmiModelDescription>")
    folder = platform or (fmpy.platform_tuple if version == "3" else fmpy.platform)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", text)
        if sources:
            archive.write(SOURCE, "sources/slide.c")
        else:
            archive.write(library, f"binaries/{folder}/slide.so")
    return path
