"""Exit with 0 if OpenGL can draw here without a screen. Standard library only: it runs before pip."""

import ctypes
import sys

EGL_PLATFORM_DEVICE_EXT = 0x313F


def works() -> bool:
    """Whether any device that EGL lists (a GPU, or Mesa's software renderer) can be started."""
    try:
        egl = ctypes.CDLL("libEGL.so.1")
        ctypes.CDLL("libGL.so.1")
    except OSError:
        return False
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    devices_address = egl.eglGetProcAddress(b"eglQueryDevicesEXT")
    display_address = egl.eglGetProcAddress(b"eglGetPlatformDisplayEXT")
    if not devices_address or not display_address:
        return False
    query_devices = ctypes.CFUNCTYPE(
        ctypes.c_uint, ctypes.c_int, ctypes.POINTER(ctypes.c_void_p), ctypes.POINTER(ctypes.c_int)
    )(devices_address)
    get_display = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_uint, ctypes.c_void_p, ctypes.c_void_p)(
        display_address
    )
    egl.eglInitialize.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]

    devices = (ctypes.c_void_p * 16)()
    count = ctypes.c_int()
    if not query_devices(16, devices, ctypes.byref(count)):
        return False
    displays = (get_display(EGL_PLATFORM_DEVICE_EXT, device, None) for device in devices[: count.value])
    return any(display and egl.eglInitialize(display, None, None) for display in displays)


if __name__ == "__main__":
    sys.exit(0 if works() else 1)
