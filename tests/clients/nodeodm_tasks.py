"""Does by PyODM all that a client of NodeODM does: nodeodm_tasks.py URL FOLDER LEAST_ZIP_BYTES [busy]

FOLDER holds the photographs. URL may hold a token, and a wrong one is then tried as well. With `busy` the node works for some
seconds on a task, which is cancelled meanwhile.
"""

import json
import os
import sys
import tempfile
import time
import urllib.request
import zipfile

from pyodm import Node
from pyodm.exceptions import NodeResponseError, TaskFailedError
from pyodm.types import TaskStatus

url, folder, least_zip_bytes = sys.argv[1], sys.argv[2], int(sys.argv[3])
busy = "busy" in sys.argv[4:]
files = sorted(os.path.join(folder, name) for name in os.listdir(folder))
node = Node.from_url(url)


def refused(what, message=""):
    try:
        what()
    except NodeResponseError as error:
        assert message in str(error), error
        return
    raise AssertionError("it was not refused")


def finish(task):
    task.wait_for_completion(interval=0.1)
    info = task.info()
    assert info.status == TaskStatus.COMPLETED and info.progress == 100 and info.last_error == "", info
    return info


info = node.info()
assert info.version.count(".") == 2 and isinstance(info.task_queue_count, int) and info.max_images is None, info
assert info.total_memory >= info.available_memory > 0 and info.cpu_cores >= 1 and info.max_parallel_tasks >= 1, info
assert info.engine == "multistage" and node.version_greater_or_equal_than("1.5.1"), info
assert {option.name for option in node.options()} >= {"feature-quality", "iterations"}
raw = json.load(urllib.request.urlopen(node.url("/options")))
assert raw and all(set(option) == {"name", "type", "value", "domain", "help"} for option in raw), raw
assert all(isinstance(option["value"], str) for option in raw), raw

if node.token:
    wrong = Node(node.host, node.port, "wrong")
    for ask in [wrong.info, wrong.options, lambda: wrong.create_task(files)]:
        refused(ask, "token does not match")

progress = []
task = node.create_task(files, {"iterations": 1, "dsm": True}, "石段 survey", progress.append, retry_timeout=0)
assert progress[-1] == 100, progress
seen = []
task.wait_for_completion(status_callback=lambda info: seen.append(info.status), interval=0.1)
info = finish(task)
assert seen[-1] == TaskStatus.COMPLETED, seen
assert info.name == "石段 survey" and info.images_count == len(files) and info.processing_time >= 0, info
assert abs(info.date_created.timestamp() - time.mktime(time.gmtime())) < 3600, info.date_created
assert info.options == [{"name": "iterations", "value": 1}], info.options
assert task.uuid in [listed["uuid"] for listed in node.get("/task/list")]

lines = task.output()
assert len(lines) > 3 and all(isinstance(line, str) for line in lines), lines
assert task.output(-2) == lines[-2:] and task.output(2) == lines[2:] and task.info(with_output=1).output == lines[1:]

with tempfile.TemporaryDirectory() as target:
    shares = []
    archive = task.download_zip(target, shares.append)
    assert os.path.getsize(archive) >= least_zip_bytes and shares and shares[-1] == 100, shares
    chunks = len(shares)
    with zipfile.ZipFile(archive) as opened:
        assert opened.testzip() is None and "report.json" in opened.namelist(), opened.namelist()
    alone = task.download_zip(os.path.join(target, "alone"), parallel_downloads=1)
    assert open(alone, "rb").read() == open(archive, "rb").read()
refused(lambda: task.get(f"/task/{task.uuid}/download/orthophoto.tif"), "Invalid asset")

if node.token:
    theirs = wrong.get_task(task.uuid)
    with tempfile.TemporaryDirectory() as target:
        for ask in [theirs.info, theirs.output, theirs.restart, theirs.cancel, theirs.remove, lambda: theirs.download_zip(target)]:
            refused(ask, "token does not match")
    node.info()

for uuid in ["wrong-uuid", "00000000-0000-0000-0000-000000000000"]:
    nothing = node.get_task(uuid)
    for ask in [nothing.info, nothing.output, nothing.restart, nothing.cancel, nothing.remove]:
        refused(ask, "not found")

assert task.restart()
assert finish(task).options == [{"name": "iterations", "value": 1}]
assert task.restart({"iterations": "2", "orthophoto-resolution": 5})
assert finish(task).options == [{"name": "iterations", "value": 2}]
refused(lambda: task.restart({"iterations": "many"}), "iterations")

assert task.cancel()
assert task.info().status == TaskStatus.CANCELED
refused(lambda: task.get(f"/task/{task.uuid}/download/all.zip"), "not completed")
# With other features nothing done before is of use, so that there is time to cancel.
assert task.restart({"max-num-features": 9000} if busy else None)
if busy:
    while task.info().status == TaskStatus.QUEUED:
        time.sleep(0.01)
    assert task.info().status == TaskStatus.RUNNING
    refused(task.restart)
    start = time.monotonic()
    assert task.cancel() and task.info().status == TaskStatus.CANCELED
    assert time.monotonic() - start < 5
    try:
        task.wait_for_completion(interval=0.1)
        raise AssertionError("a cancelled task failed")
    except TaskFailedError:
        pass
    assert task.restart()
finish(task)

assert task.remove()
refused(task.remove, "not found")
assert node.get("/task/list") == [] or task.uuid not in [listed["uuid"] for listed in node.get("/task/list")]
# Removed while it waits or runs.
task = node.create_task(files, {}, None, outputs=["x"], skip_post_processing=True)
assert task.info().name.startswith("Task of") and task.remove()
print(f"{len(files)} photographs, {chunks} parts of the archive, {len(lines)} lines")
