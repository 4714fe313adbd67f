"""Prints the statistics that RADV wrote while gpu_meter compiled, as a table in Markdown. Of two files it prints those of the first, an
arrow, and those of the second, where they differ."""

import re
import sys

# RADV's names of statistics, and the columns that show them. VGPRs are those that the waves which fit leave to each; of these the shader
# needs the live ones. RADV's subgroups are AMD's waves.
COLUMNS = {
    "threads": "threads",
    "VGPRs": "VGPR",
    "Pre-Sched VGPRs": "VGPR live",
    "Pre-Sched SGPRs": "SGPR live",
    "Spilled VGPRs": "spilled",
    "LDS size": "LDS, bytes",
    "Subgroups per SIMD": "waves a SIMD",
    "Instructions": "instructions",
    "VALU": "vector",
    "SALU": "scalar",
    "VMEM": "memory",
    "SMEM": "scalar memory",
    "Branches": "branches",
    "Latency": "latency, cycles",
    "Inverse Throughput": "busy, cycles",
}


def read(path):
    """The device, and the columns of each stage by its name."""
    device, stages = "", {}
    last = {}
    for line in open(path, encoding="utf-8"):
        if line.startswith("METER_DEVICE "):
            device = line.split(" ", 1)[1].strip()
        elif found := re.match(r"METER_PIPELINE (\d+) (\S+)\.wgsl (\S+)(.*)", line):
            threads, shader, entry, defines = found.groups()
            name = shader if entry == shader else f"{shader}: {entry}"
            # SH_DEGREE_2 follows SH_DEGREE_1; defines of subgroups are the device's.
            words = re.sub(r"SH_DEGREE_", "SH ", re.sub(r"SH_DEGREE_\d (?=SH)| SUBGROUPS\w*", "", defines))
            name += re.sub(r" (?=[A-Z]{2})", ", ", words)
            last = stages[name] = {"threads": threads}
        elif (found := re.match(r"([A-Za-z -]+): (\d+)$", line)) and found[1] in COLUMNS:
            last[found[1]] = found[2]
    lost = [name for name, values in stages.items() if "VGPRs" not in values]
    if lost or not stages:
        sys.exit(f"{path}: the driver printed no statistics of {lost or 'any shader'}")
    # Most entry points are the same for all degrees.
    base = {name: re.sub(r", SH \d", "", name) for name in stages}
    return device, {name: v for name, v in stages.items() if name == base[name] or v != stages[base[name]]}


files = [read(path) for path in sys.argv[1:]]
print(files[-1][0] + "\n")
print("| stage | " + " | ".join(COLUMNS.values()) + " |")
print("| --- |" + " ---: |" * len(COLUMNS))
for name in sorted({name for _, stages in files for name in stages}):
    states = [stages[name] for _, stages in files if name in stages]
    note = "" if len(states) == len(files) else " (new)" if name in files[-1][1] else " (gone)"
    cells = [list(dict.fromkeys(state.get(column, "?") for state in states)) for column in COLUMNS]
    print(f"| {name}{note} | " + " | ".join(" → ".join(cell) for cell in cells) + " |")
