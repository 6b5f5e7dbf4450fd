"""Draws the cost of an update, and the throughput of more worlds, members and workers."""

from pathlib import Path

from matplotlib.figure import Figure

from torchrl_h2o.whole_file import whole_file

LABELS = {
    "buffer": "simulated transitions in the buffer",
    "batch": "rows of a stream in a batch",
    "width": "width of the hidden layers",
    "population": "runs in one process",
}
GROWTH = {
    "worlds": ("simulated worlds in one process", "transitions per second"),
    "population": ("runs in one process", "updates per second, all runs"),
    "workers": ("Ray workers", "transitions per second"),
}
COLOURS = {"in memory": "#0b6e4f", "memory-mapped": "#c8553d"}


def draw_scaling(path: Path, costs: list[dict]) -> None:
    """Draw scaling.png with logarithmic axes.

    Args:
        path: PNG file to write.
        costs: entries of scaling.json: the factor, its size, seconds and bytes.
    """
    columns = list(dict.fromkeys(cost["grows"] for cost in costs))
    figure = Figure((4 * len(columns), 6), layout="constrained")
    axes = figure.subplots(2, len(columns), sharex="col", sharey="row", squeeze=False)
    for column, grows in enumerate(columns):
        seconds, memory = axes[:, column]
        for storage, colour in COLOURS.items():
            rows = [cost for cost in costs if cost["grows"] == grows and cost["storage"] == storage]
            if not rows:
                continue
            sizes = [cost["size"] for cost in rows]
            for key, style in (("seconds_per_update", "o-"), ("seconds_per_sample", "s--")):
                label = f"{key.replace('seconds_per_', 'one ')}, {storage}"
                seconds.plot(sizes, [1e3 * cost[key] for cost in rows], style, ms=4, color=colour, label=label)
            megabytes = [max(cost["memory"], 1e5) / 1e6 for cost in rows]  # pages are too coarse for less
            memory.plot(sizes, megabytes, "o-", ms=4, color=colour)
        memory.set(xlabel=LABELS.get(grows, grows), xscale="log")
        sizes = sorted({cost["size"] for cost in costs if cost["grows"] == grows})
        memory.set_xticks(sizes, [f"{size:,}" for size in sizes])
        memory.minorticks_off()
    axes[0, 0].set(ylabel="ms", yscale="log")
    axes[1, 0].set(ylabel="MB", yscale="log")
    axes[0, 0].legend(frameon=False, fontsize=8)
    for axis in axes.flat:
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(alpha=0.3)
    with whole_file(path) as partial:
        figure.savefig(partial, dpi=150)


def draw_growth(path: Path, rates: list[dict], pays_until: dict[str, int]) -> None:
    """Draw growth.png: the throughput over the size, with a line at the size from which more do not pay.

    Args:
        path: PNG file to write.
        rates: entries ``growth`` of scaling.json: the factor, its size, and its rate per second.
        pays_until: by factor, the last size that pays; without those whose largest size still pays.
    """
    factors = [grows for grows in GROWTH if any(rate["grows"] == grows for rate in rates)]
    figure = Figure((4 * len(factors), 3.2), layout="constrained")
    axes = figure.subplots(1, len(factors), squeeze=False)
    for axis, grows in zip(axes.flat, factors, strict=True):
        sizes, per_second = zip(*((r["size"], r["per_second"]) for r in rates if r["grows"] == grows), strict=True)
        what, unit = GROWTH[grows]
        axis.plot(sizes, per_second, "o-", ms=4, color=COLOURS["in memory"])
        if grows in pays_until:
            axis.axvline(pays_until[grows], color=COLOURS["memory-mapped"], ls=":")
            axis.set_title(f"more than {pays_until[grows]:,} do not pay", fontsize=10, color=COLOURS["memory-mapped"])
        axis.set(xlabel=what, ylabel=unit, xscale="log", ylim=(0.0, 1.1 * max(per_second)))
        axis.set_xticks(sizes, [f"{size:,}" for size in sizes])
        axis.minorticks_off()
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(alpha=0.3)
    with whole_file(path) as partial:
        figure.savefig(partial, dpi=150)
