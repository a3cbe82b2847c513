import asyncio

import numpy as np
import pytest

from imgcal.live_page.wire import frame_message, read_message


def test_messages_arrive_one_after_another():
    async def read_two():
        reader = asyncio.StreamReader()
        reader.feed_data(frame_message("first", {"a": np.arange(3)}) + frame_message("second", {}) + b"\x05")
        reader.feed_eof()
        found = [await read_message(reader), await read_message(reader)]
        with pytest.raises(asyncio.IncompleteReadError):
            await read_message(reader)
        return found

    (kind, content), second = asyncio.run(read_two())
    assert kind == "first" and content["a"].tolist() == [0, 1, 2] and second == ("second", {})
