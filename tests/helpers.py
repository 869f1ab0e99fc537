"""What several test files ask of a task: its table, the title of its figures, a figure by its file's name."""

from common.tasks import task_of


def table_of(metrics):
    """The printed table of an evaluation."""
    return task_of(metrics["env_id"]).table(metrics)


def headline_of(metrics):
    """The title of an evaluation's figures."""
    return task_of(metrics["env_id"]).headline(metrics)


def figure_of(name, arrays, metrics, curves=()):
    """One of an evaluation's figures."""
    return task_of(metrics["env_id"]).figures(arrays, metrics, list(curves))[name]
