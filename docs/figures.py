"""Draw the network (README) and one policy for all phases (docs/rocket.md), after the paper's Figures 2 and 1.

    python docs/figures.py

Both figures are laid out in inches: one data unit is one inch, so that box sizes and font sizes go together.
"""

from pathlib import Path as FilePath

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Circle, FancyArrowPatch, FancyBboxPatch, Polygon, Rectangle
from matplotlib.path import Path

HERE = FilePath(__file__).resolve().parent
INK, GREY, LINE, PALE = "#1f2a37", "#5f6b7a", "#a9b3bf", "#f4f6f8"
BLUE, GREEN, RED, PURPLE = "#1f5fa8", "#1d8348", "#c0392b", "#6c3d91"
TEAL, AMBER, BROWN = "#0e7c86", "#b9770e", "#7a4a2b"
TINT = {BLUE: "#e3edf8", GREEN: "#e0f2e7", RED: "#fae6e3", PURPLE: "#efe6f6", GREY: "#eceff2"}
TINT |= {TEAL: "#dff1f2", AMBER: "#fbf0da", BROWN: "#f3e9e2"}
STYLE = {"font.family": "DejaVu Sans", "mathtext.fontset": "dejavusans", "font.size": 11, "text.color": INK}


# ------------------------------------------------------------------------------------------------- drawing helpers
def canvas(width, height):
    """A white figure of width x height inches with one axes in inches."""
    fig = plt.figure(figsize=(width, height), facecolor="white")
    ax = fig.add_axes((0, 0, 1, 1))
    ax.set(xlim=(0, width), ylim=(0, height))
    ax.axis("off")
    return fig, ax


def save(fig, name):
    """Write the figure without time stamps or version strings."""
    fig.savefig(HERE / name, dpi=200, metadata={"Software": None}, pil_kwargs={"optimize": True})
    plt.close(fig)


def text(ax, x, y, s, size=11, color=INK, ha="center", va="center", **kw):
    ax.text(x, y, s, fontsize=size, color=color, ha=ha, va=va, zorder=6, **kw)


def box(ax, x, y, w, h, color, label="", size=11, fill=None, lw=1.4, z=3, **kw):
    """A rounded box with its lower left corner at (x, y) and a centred label."""
    style = "round,pad=0,rounding_size=0.08"
    face = TINT.get(color, "white") if fill is None else fill
    ax.add_patch(FancyBboxPatch((x, y), w, h, boxstyle=style, fc=face, ec=color, lw=lw, zorder=z, **kw))
    text(ax, x + w / 2, y + h / 2, label, size, linespacing=1.35)


def arrow(ax, *points, color=INK, head="-|>", lw=1.4, **kw):
    """An arrow along the polyline through points; its tip is the last point."""
    style = {"mutation_scale": 12, "zorder": 4, "joinstyle": "round", "capstyle": "butt"} | kw
    ax.add_patch(FancyArrowPatch(path=Path(points), arrowstyle=head, color=color, lw=lw, **style))


def cells(ax, x, y, size, faces, edge):
    """A row of square cells, one per face colour."""
    for i, face in enumerate(faces):
        ax.add_patch(Rectangle((x + i * size, y), size, size, fc=face, ec=edge, lw=0.9, zorder=4))


# ------------------------------------------------------------------------ figure 1: segmented guidance or one policy
COLUMN, GROUND, RISE, FOOT, ROOF = 1.16, 2.42, 1.87, 0.98, 2.02
PHASES = (("6 boosters", "+ stage 1"), ("3 boosters", "+ stage 1"), ("stage 1", ""), ("stage 2", ""))
CONTROLLERS = (TEAL, AMBER, PURPLE, BROWN)


def ascent(u):
    """The ascent curve over u in [0, 1]: vertical at lift-off, horizontal at insertion."""
    return 4 * COLUMN * u, GROUND + RISE * (1 - (1 - u) ** 2) ** 0.77


def curve(ax, x0, u0, u1, color, lw=3.2, z=4, **kw):
    x, y = ascent(np.linspace(u0, u1, 200))
    ax.plot(x0 + x, y, color=color, lw=lw, solid_capstyle="butt", zorder=z, **kw)


def rocket(ax, x0, u, scale=0.34):
    """A small rocket on the curve, pointing along it."""
    (xa, xb), (ya, yb) = ascent(np.array([u, u + 1e-3]))
    angle = np.arctan2(yb - ya, xb - xa)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    hull = np.array([[-0.5, -0.16], [0.25, -0.16], [0.42, -0.1], [0.6, 0], [0.42, 0.1], [0.25, 0.16], [-0.5, 0.16]])
    fins = np.array([[-0.6, -0.34], [-0.25, -0.16], [-0.25, 0.16], [-0.6, 0.34], [-0.5, 0]])
    for shape, face in ((fins, GREY), (hull, "white")):
        ax.add_patch(Polygon(scale * shape @ turn.T + (x0 + xa, ya), fc=face, ec=INK, lw=1.1, zorder=8))


def mission(ax, x0, title, subtitle):
    """What both halves share: headings, target orbit, launch pad and the names of the phases."""
    centre, end = x0 + 2 * COLUMN, x0 + 4 * COLUMN
    text(ax, centre, 5.12, title, 15, weight="bold")
    text(ax, centre, 4.80, subtitle, 11.5, GREY)
    ax.plot([end - 0.98, end + 0.1], [GROUND + RISE] * 2, color=GREY, lw=1.2, ls=(0, (4, 3)), zorder=2)
    text(ax, end + 0.1, GROUND + RISE + 0.15, "target orbit", 10.5, GREY, ha="right")
    ax.plot([x0 - 0.14, x0 + 0.22], [GROUND - 0.03] * 2, color=INK, lw=2.5, solid_capstyle="round")
    for i, lines in enumerate(PHASES):
        x = x0 + (i + 0.5) * COLUMN
        text(ax, x, 0.74, f"Phase {i + 1}", 11, weight="bold")
        for line, y in zip(lines, (0.46, 0.28)):
            text(ax, x, y, line, 10, GREY, va="baseline")


def segmented(ax, x0):
    """Left half: a controller per phase, and the hand-overs between them."""
    mission(ax, x0, "Segmented guidance", "one controller per phase")
    for i, color in enumerate(CONTROLLERS):
        x = x0 + i * COLUMN
        curve(ax, x0, i / 4, (i + 1) / 4, color)
        box(ax, x + 0.1, FOOT, COLUMN - 0.2, ROOF - FOOT, color)
        text(ax, x + COLUMN / 2, 1.78, "Controller", 10.5, weight="bold")
        text(ax, x + COLUMN / 2, 1.35, "own model,\nown goal,\nown tuning", 10, linespacing=1.2)
        arrow(ax, (x + COLUMN / 2, ROOF), (x + COLUMN / 2, ascent((i + 0.5) / 4)[1] - 0.03), color=color)
    for i in (1, 2, 3):
        x, y = ascent(i / 4)
        ax.plot([x0 + x] * 2, [FOOT, y - 0.12], color=RED, lw=1.3, ls=(0, (3, 2.5)), zorder=2)
        ax.add_patch(Circle((x0 + x, y), 0.12, fc="white", ec=RED, lw=2.2, zorder=5))
        text(ax, x0 + x, y - 0.005, "!", 12, RED, weight="bold")
    text(ax, x0, 4.32, "hand-over points:", 11, RED, ha="left", weight="bold")
    text(ax, x0, 4.10, "the fragile places", 11, RED, ha="left", weight="bold")
    rocket(ax, x0, 0.035)


def one_policy(ax, x0, now=16, window=6, steps=24):
    """Right half: the same flight with one policy whose memory window slides along it."""
    mission(ax, x0, "One policy", "one transformer through all phases")
    size = 4 * COLUMN / steps
    u = np.linspace((now - window) / steps, now / steps, 100)
    x, y = ascent(u)
    curve(ax, x0, 0, 1, BLUE)
    curve(ax, x0, u[0], u[-1], GREEN, lw=15, alpha=0.28, z=3)
    curve(ax, x0, 0.06, 0.06 + window / steps, GREEN, lw=15, alpha=0.10, z=3)
    xs, ys = ascent(np.linspace(0.10, 0.40, 40))
    arrow(ax, *zip(x0 + xs - 0.17, ys + 0.17), color=GREEN, lw=1.8)
    ax.fill_between(x0 + x, ROOF, y, color=TINT[GREEN], lw=0, zorder=1)
    for edge, top in ((x[0], y[0]), (x[-1], y[-1])):
        ax.plot([x0 + edge] * 2, [ROOF, top], color=GREEN, lw=1.1, ls=(0, (3, 2.5)), zorder=2)
    text(ax, x0 + x.mean(), 2.72, "memory $m_t$:\nthe last $L_{mem}$\nsteps", 10.5, GREEN, linespacing=1.3)
    box(ax, x0 - 0.1, FOOT, 4 * COLUMN + 0.2, ROOF - FOOT, BLUE)
    faces = [PALE] * (now - window) + ["#8fcfa9"] * window + [BLUE] + ["white"] * (steps - now - 1)
    cells(ax, x0, 1.66, size, faces, GREY)
    text(ax, x0 + 2 * COLUMN, 1.29, r"Transformer policy  $\pi_\theta(\,\cdot\,|\,s_t, m_t)$", 13)
    mid = (now + 0.5) / steps
    foot = x0 + 4 * COLUMN * mid
    arrow(ax, (foot, ROOF), (foot, ascent(mid)[1] - 0.1), color=BLUE)
    text(ax, foot + 0.12, 2.72, r"$a_t \sim \pi_\theta$", 12, BLUE, ha="left")
    text(ax, x0, 4.32, "the memory slides along:", 11, GREEN, ha="left", weight="bold")
    text(ax, x0, 4.10, "no hand-over", 11, GREEN, ha="left", weight="bold")
    rocket(ax, x0, mid)


def draw_comparison():
    fig, ax = canvas(10.2, 5.4)
    segmented(ax, 0.26)
    one_policy(ax, 5.30)
    ax.plot([5.1, 5.1], [0.2, 5.2], color=LINE, lw=1)
    save(fig, "segmented_vs_one_policy.png")


# ---------------------------------------------------------------------------------------- figure 2: the architecture
def pipeline_input(ax):
    """Upper strip, left: environment, observation, encoder, the stack of blocks."""
    box(ax, 0.2, 5.0, 1.4, 1.5, GREY)
    text(ax, 0.9, 6.2, "Environment", 11, weight="bold")
    text(ax, 0.9, 5.6, "double integrator\nVan der Pol\nrocket ascent", 10, GREY, linespacing=1.35)
    for i, name in enumerate((r"$x_t$", r"$x_{target}$", r"$\tau$", r"$\phi$")):
        ax.add_patch(Rectangle((1.98, 6.05 - 0.3 * i), 0.72, 0.3, fc="white", ec=INK, lw=1.1, zorder=4))
        text(ax, 2.34, 6.2 - 0.3 * i, name, 11.5)
    text(ax, 2.34, 6.5, r"$o_t$", 13)
    text(ax, 2.34, 4.92, "state, target,\ntime, phase", 10, GREY, linespacing=1.2)
    box(ax, 3.06, 5.15, 1.3, 1.2, BLUE)
    text(ax, 3.71, 6.05, "Encoder", 11, weight="bold")
    text(ax, 3.71, 5.6, "linear\n+ GELU", 11, linespacing=1.3)
    for i in (2, 1, 0):
        box(ax, 4.74 + 0.09 * i, 5.15 + 0.09 * i, 1.3, 1.2, BLUE, z=3 - 0.2 * i)
    text(ax, 5.39, 6.05, "GTrXL", 11, weight="bold")
    text(ax, 5.39, 5.6, "stack of\nblocks", 11, linespacing=1.3)


def pipeline_output(ax):
    """Upper strip, right: the two heads and what PPO minimises."""
    box(ax, 6.76, 5.82, 1.5, 0.78, PURPLE)
    text(ax, 7.51, 6.36, "Policy head", 11, weight="bold")
    text(ax, 7.51, 6.05, r"Gaussian $\mu$, $\log\,\sigma$", 11)
    box(ax, 6.76, 4.9, 1.5, 0.78, TEAL)
    text(ax, 7.51, 5.44, "Value head", 11, weight="bold")
    text(ax, 7.51, 5.12, r"$V_\phi(s_t, m_t)$", 11)
    box(ax, 8.66, 4.9, 1.34, 1.7, RED)
    text(ax, 9.33, 6.36, "PPO", 11, weight="bold")
    text(ax, 9.33, 6.11, "minimises", 10, GREY)
    for line, y in ((r"$-\,L^{CLIP}$", 5.79), (r"$+\;c_1\,L^{VF}$", 5.46), (r"$-\;c_2\,H[\pi_\theta]$", 5.13)):
        text(ax, 8.92, y, line, 12, ha="left")


def pipeline_arrows(ax, y=5.75, action=6.9, reward=7.22):
    """The flow through the upper strip, and the loop back to the environment."""
    for x0, x1 in ((1.6, 1.98), (2.7, 3.06), (4.36, 4.74)):
        arrow(ax, (x0, y), (x1, y))
    for head in (6.21, 5.29):
        arrow(ax, (6.22, y), (6.49, y), (6.49, head), (6.76, head))
        arrow(ax, (8.26, head), (8.66, head))
    arrow(ax, (7.51, 6.6), (7.51, action), (1.15, action), (1.15, 6.5))
    arrow(ax, (0.65, 6.5), (0.65, reward), (9.33, reward), (9.33, 6.6))
    label = {"bbox": {"fc": "white", "ec": "none", "pad": 2.5}}
    text(ax, 4.33, action, r"action  $a_t \sim \pi_\theta(\,\cdot\,|\,s_t, m_t)$", 11, **label)
    text(ax, 4.99, reward, r"reward  $r_t$", 11, **label)


def block_attention(ax, y):
    """The open block, left: memory and current input into multi-head attention."""
    cells(ax, 0.4, y - 0.15, 0.3, ["#8fcfa9"] * 5, GREEN)
    cells(ax, 1.98, y - 0.15, 0.3, [BLUE], BLUE)
    text(ax, 2.13, y, r"$x$", 12, "white")
    text(ax, 1.15, y + 0.50, "memory $m_t$: inputs of\nthe last $L_{mem}$ steps", 10, GREEN, linespacing=1.3)
    for i in (2, 1, 0):
        box(ax, 2.74 + 0.07 * i, y - 0.55 + 0.07 * i, 2.0, 1.1, BLUE, z=3 - 0.2 * i)
    text(ax, 3.74, y + 0.33, "Multi-head attention", 11, weight="bold")
    text(ax, 3.74, y - 0.14, r"$A_{i,j} = \frac{q_i \cdot (k_j + R_{i-j})}{\sqrt{d_k}}$", 15)
    arrow(ax, (2.28, y), (2.74, y))
    text(ax, 2.48, y + 0.14, r"$q$", 12)
    ax.plot([0.4, 0.4, 2.28, 2.28], [y - 0.21, y - 0.28, y - 0.28, y - 0.21], color=INK, lw=1.2, zorder=4)
    arrow(ax, (1.34, y - 0.28), (1.34, y - 0.42), (2.74, y - 0.42))
    text(ax, 2.45, y - 0.57, r"$k,\,v$", 12)


def sublayer(ax, y, x_in, x_branch, x_sum, x_norm, x_gate, name, rail=0.9):
    """Residual sum, LayerNorm and gate; name enters the sum and the gate by the rail above."""
    plus = 0.12
    arrow(ax, (x_in, y), (x_sum - plus, y))
    ax.add_patch(Circle((x_sum, y), plus, fc="white", ec=INK, lw=1.4, zorder=5))
    text(ax, x_sum, y, "+", 13)
    arrow(ax, (x_sum + plus, y), (x_norm, y))
    box(ax, x_norm, y - 0.3, 0.6, 0.6, GREY)
    text(ax, x_norm + 0.3, y, "Layer\nNorm", 10, linespacing=1.2)
    arrow(ax, (x_norm + 0.6, y), (x_gate, y))
    text(ax, x_norm + 0.71, y - 0.19, r"$y$", 12)
    box(ax, x_gate, y - 0.24, 0.54, 0.48, AMBER)
    text(ax, x_gate + 0.27, y, "gate", 10.5)
    (x0, y0), middle = x_branch, x_gate + 0.27
    arrow(ax, (x0, y0), (x0, y + rail), (middle, y + rail), (middle, y + 0.24))
    arrow(ax, (x_sum, y + rail), (x_sum, y + plus))
    text(ax, middle + 0.08, y + 0.55, name, 12, ha="left")


def block_notes(ax):
    """The open block, below: the paper's equations, and how R is had, which is ours."""
    text(ax, 0.4, 1.70, r"$q_i = x_i W^Q,\;\; k_j = x_j W^K,\;\; R$ learned per head and distance", 11, ha="left")
    text(ax, 0.4, 1.42, r"softmax over $j$: the memory and the current input", 11, ha="left")
    text(ax, 0.4, 0.86, r"$h_1 = \mathrm{gate}(x,\;\mathrm{LayerNorm}(x + \mathrm{MultiHead}(x)))$", 12, ha="left")
    text(ax, 0.4, 0.52, r"$h_2 = \mathrm{gate}(h_1,\;\mathrm{LayerNorm}(h_1 + \mathrm{MLP}(h_1)))$", 12, ha="left")
    box(ax, 5.7, 0.4, 4.1, 1.42, AMBER)
    text(ax, 7.75, 1.53, r"$\mathrm{gate}(x, y) = \lambda \odot x + (1 - \lambda) \odot y$", 13)
    text(ax, 7.75, 1.13, r"$\lambda = \sigma(W_g\,[x, y] + b_g)$", 13)
    text(ax, 7.75, 0.70, r"$b_g > 0$ at the start: close to the identity", 11)


def open_block(ax, y=2.85):
    """Lower panel: one block opened, joined to the stack above by a wedge."""
    box(ax, 0.2, 0.2, 9.8, 4.2, LINE, fill=PALE, z=1)
    wedge = Polygon([(4.74, 5.15), (6.04, 5.15), (6.6, 4.4), (4.18, 4.4)], fc="#e6eaee", ec="none", zorder=0.5)
    ax.add_patch(wedge)
    text(ax, 0.4, 4.13, "Inside one block", 12.5, ha="left", weight="bold")
    block_attention(ax, y)
    sublayer(ax, y, 4.88, (2.13, y + 0.15), 5.17, 5.43, 6.27, r"$x$")
    ax.plot([6.81, 7.0], [y, y], color=INK, lw=1.4, zorder=4)
    ax.add_patch(Circle((7.0, y), 0.035, fc=INK, ec=INK, zorder=5))
    text(ax, 7.0, y - 0.2, r"$h_1$", 12)
    arrow(ax, (7.0, y), (7.23, y))
    box(ax, 7.23, y - 0.3, 0.52, 0.6, BLUE)
    text(ax, 7.49, y, "MLP", 10.5)
    sublayer(ax, y, 7.75, (7.0, y), 8.03, 8.28, 9.12, r"$h_1$")
    arrow(ax, (9.66, y), (10.0, y))
    text(ax, 9.82, y + 0.18, r"$h_2$", 12)
    for x in (6.54, 9.39):
        ax.plot([x, x], [1.82, y - 0.24], color=AMBER, lw=1.3, ls=(0, (3, 2.5)), zorder=2)
    block_notes(ax)


def draw_architecture():
    fig, ax = canvas(10.2, 7.5)
    pipeline_input(ax)
    pipeline_output(ax)
    pipeline_arrows(ax)
    open_block(ax)
    save(fig, "architecture.png")


if __name__ == "__main__":
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(STYLE)
        draw_comparison()
        draw_architecture()
