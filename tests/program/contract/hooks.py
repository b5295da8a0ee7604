"""What schemathesis does not know by itself: bodies that are bytes."""

import schemathesis


@schemathesis.serializer("application/offset+octet-stream")
def offset_octet_stream(context, value):
    return value if isinstance(value, bytes) else str(value).encode()
