"""How to open a chapter as a notebook that runs: here, or at a service that reads the repository."""

from html import escape

from .settings import Settings


def opening_bar(notebook: str, settings: Settings) -> str:
    """HTML under a chapter's title.

    Args:
        notebook: Path of the notebook in the project.
        settings: With a repository, there are links to services.
    """
    name = notebook.rpartition("/")[2]
    links = [f'<a href="{escape(url)}">Open in {service}</a>' for service, url in settings.launches(notebook).items()]
    colab = _COLAB.format(repository=escape(settings.repository)) if links else ""
    return (
        f'<div class="gsnb-open"><a href="{escape(name)}" download>Download this notebook</a> '
        f"{' '.join(links)}<details><summary>Run it in JupyterLab</summary>"
        f"<p>In the project's folder: <code>make lab</code>, then open <code>course/{escape(name)}</code>: a copy with "
        f"empty exercises, which is yours to change. With pip: "
        f'<a href="../docs/install.html">installing</a>.</p>{colab}</details></div>'
    )


_COLAB = (
    "<p>In Colab, first run a new cell with <code>%pip install git+{repository}</code>, and restart the runtime when "
    "it asks. Binder installs the package itself, which takes some minutes at the first start.</p>"
)
