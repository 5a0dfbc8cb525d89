"""Which executor the options of a command ask for."""

from optipmb_client.bulk.executors import Executor, Here, Processes
from optipmb_client.extras import needed


def executor_for(jobs: int, ray: str | None = None) -> Executor:
    """Return the executor for so many tasks at once.

    Args:
        jobs: tasks at once; on a Ray cluster 0 means as many as it has processors.
        ray: the address of a Ray cluster, `local` for one that is started here; None: processes of this machine.

    Raises:
        ClientError: Ray is not installed.
    """
    if ray is not None:
        needed("--ray", "ray", "ray")
        from optipmb_client.bulk.cluster import RayCluster  # noqa: PLC0415  packages of an extra

        return RayCluster(ray, jobs)
    return Processes(jobs) if jobs > 1 else Here()
