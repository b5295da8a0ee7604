"""Drives the service by a client that openapi-python-client made of openapi.yaml: generated_client.py URL TOKEN PHOTOGRAPH...

The folder of the package `client` must be on PYTHONPATH.
"""

import io
import sys
import time
import zipfile

from client import AuthenticatedClient
from client.api.datasets import add_images, create_dataset, dataset_images, delete_dataset
from client.api.jobs import cancel_job, create_job, delete_job, get_job, list_jobs
from client.api.results import job_archive, job_images, job_output, job_outputs
from client.models import AddImagesBody, Dataset, Job, JobState, NewDataset, NewJob, Problem, UploadResult
from client.types import File

url, token, *photographs = sys.argv[1:]
client = AuthenticatedClient(base_url=url, token=token, raise_on_unexpected_status=True)

dataset = create_dataset.sync(client=client, body=NewDataset(name="by a generated client"))
assert isinstance(dataset, Dataset), dataset
files = [File(payload=open(path, "rb"), file_name=path.rsplit("/", 1)[-1], mime_type="image/jpeg") for path in photographs]
stored = add_images.sync(dataset.id, client=client, body=AddImagesBody(images=files))
assert isinstance(stored, UploadResult) and stored.stored == len(files), stored
listed = dataset_images.sync(dataset.id, client=client)
assert len(listed.images) == len(files), listed

job = create_job.sync(client=client, body=NewJob(dataset_id=dataset.id, name="generated"))
assert isinstance(job, Job) and job.state in (JobState.QUEUED, JobState.RUNNING), job
while job.state in (JobState.QUEUED, JobState.RUNNING):
    time.sleep(0.1)
    job = get_job.sync(job.id, client=client)
assert job.state == JobState.SUCCEEDED and job.models[0].images > 2, job
assert [listed.id for listed in list_jobs.sync(client=client).jobs] == [job.id]

verdicts = job_images.sync(job.id, client=client)
assert verdicts.total == len(files) and all(image.sha256 for image in verdicts.images), verdicts
outputs = job_outputs.sync(job.id, client=client)
paths = {output.path: output.size_bytes for output in outputs.files}
points = job_output.sync_detailed(job.id, "ply/0/points.ply", client=client)
assert points.status_code == 200 and len(points.content) == paths["ply/0/points.ply"], points.status_code
archive = job_archive.sync_detailed(job.id, client=client)
with zipfile.ZipFile(io.BytesIO(archive.content)) as opened:
    assert opened.testzip() is None and set(opened.namelist()) == set(paths), opened.namelist()

refused = cancel_job.sync(job.id, client=client)
assert isinstance(refused, Problem) and refused.code == "job_not_active", refused
assert delete_job.sync_detailed(job.id, client=client).status_code == 204
assert delete_dataset.sync_detailed(dataset.id, client=client).status_code == 204
print(f"{len(files)} photographs, {job.models[0].points} points, {len(paths)} outputs")
