"""Functions that tests run in worker processes, which import them by name."""

import os
import signal
import time

import numpy as np

from jaxba import JaxbaError


def double(number: int) -> int:
    if number == 13:
        os.kill(os.getpid(), signal.SIGKILL)
    if number == 14:
        os._exit(3)
    if number == 15:
        raise ValueError("odd")
    if number == 16:
        raise JaxbaError("disk full")
    if number == 17:
        np.ones(int(3e9), np.uint8)
    return 2 * number


def threads(_: int) -> dict[str, object]:
    import cv2
    from threadpoolctl import threadpool_info

    _ = np.ones((2, 2)) @ np.ones((2, 2))
    time.sleep(0.1)
    return {"cv2": cv2.getNumThreads(), "blas": [pool["num_threads"] for pool in threadpool_info()], "pid": os.getpid()}
