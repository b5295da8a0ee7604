"""Uploads one file by tuspy, going on whenever the connection breaks: tus_upload.py ENDPOINT DATASET FILE NAME"""

import sys

import requests
from tusclient.client import TusClient
from tusclient.exceptions import TusCommunicationError

endpoint, dataset, file, name = sys.argv[1:]
client = TusClient(endpoint)
url, went_on = None, 0
while True:
    try:
        uploader = client.uploader(
            file, url=url, chunk_size=1 << 18, metadata={"dataset": dataset, "path": name}, upload_checksum=went_on % 2 == 0
        )
        if url is None:
            url = uploader.create_url()
            uploader.set_url(url)
        uploader.upload()
        break
    except (TusCommunicationError, requests.exceptions.RequestException) as error:
        went_on += 1
        if went_on > 200:
            raise
print(f"went on {went_on} times")
