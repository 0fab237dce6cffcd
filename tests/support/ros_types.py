"""Publishers of serialized messages, also of types that PyPI has no wheel of.

rclpy hands the type support of a message class to the middleware: a C struct that names the type
and knows how to serialize it. Whoever publishes and receives serialized bytes alone needs no more
of it than the name and the type hash. So the struct of `nav_msgs/msg/Path` is copied, and the copy
carries another name and hash: on the wire, and to every other node, it is that type.

The structs are those of `rosidl_runtime_c/message_type_support_struct.h`,
`rosidl_runtime_c/type_hash.h` and `rosidl_typesupport_fastrtps_cpp/message_type_support.h` in the
wheels' include folder; so this is for `rmw_fastrtps_cpp` only.
"""

import ctypes
from functools import cache
from importlib import import_module
from typing import Any

from nav_msgs.msg import Path as Lender

_SERIALIZER = b"rosidl_typesupport_fastrtps_c"
# What describes the fields. Jazzy's middleware refuses a type without it; of a type that has no
# wheel it is told the lender's fields, which nobody reads.
_DESCRIBER = b"rosidl_typesupport_introspection_c"
# Newer ones look for it too, go on without it, and leave an error set, which the next one would be
# printed with.
_reset_error = ctypes.CDLL("librcutils.so").rcutils_reset_error
_KEPT: list[object] = []  # the middleware keeps pointers to these for ever


class _TypeSupport(ctypes.Structure):
    _fields_ = (
        ("identifier", ctypes.c_char_p),
        ("data", ctypes.c_void_p),
        ("handle_for", ctypes.c_void_p),
        ("type_hash", ctypes.c_void_p),
        ("type_description", ctypes.c_void_p),
        ("type_sources", ctypes.c_void_p),
    )


class _Callbacks(ctypes.Structure):
    _fields_ = (
        ("message_namespace", ctypes.c_char_p),
        ("message_name", ctypes.c_char_p),
        ("cdr_serialize", ctypes.c_void_p),
        ("cdr_deserialize", ctypes.c_void_p),
        ("get_serialized_size", ctypes.c_void_p),
        ("max_serialized_size", ctypes.c_void_p),
        ("key_callbacks", ctypes.c_void_p),
    )


class _TypeHash(ctypes.Structure):
    _fields_ = (("version", ctypes.c_uint8), ("value", ctypes.c_uint8 * 32))


_HandleFor = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p, ctypes.c_char_p)
_GetHash = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)
_pointer_in = ctypes.pythonapi.PyCapsule_GetPointer
_pointer_in.restype, _pointer_in.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
_capsule = ctypes.pythonapi.PyCapsule_New
_capsule.restype = ctypes.py_object
_capsule.argtypes = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]


def publisher(node: Any, topic: str, kind: tuple[str, str], qos: Any) -> Any:
    """An rclpy publisher of bytes; `kind` is as for `message_class`."""
    made = node.create_publisher(message_class(*kind), topic, qos)
    _reset_error()
    return made


@cache
def message_class(type_name: str, type_hash: str) -> Any:
    """The class that rclpy takes for `type_name`, such as `tf2_msgs/msg/TFMessage`.

    Where no wheel has the type, the class is good for serialized messages only, and its node
    describes the type wrongly to whoever asks.

    Args:
        type_name: package/msg/Name.
        type_hash: the type's hash (REP-2016), `RIHS01_` and 64 hexadecimal digits.
    """
    package, _, name = type_name.split("/")
    try:
        return getattr(import_module(f"{package}.msg"), name)
    except ImportError:
        support = _renamed(package, name, bytes.fromhex(type_hash.removeprefix("RIHS01_")))
    # rclpy checks that these are set; they are for messages as objects.
    unused = dict.fromkeys(
        ("_CREATE_ROS_MESSAGE", "_CONVERT_FROM_PY", "_CONVERT_TO_PY", "_DESTROY_ROS_MESSAGE"),
        object(),
    )
    return type(f"Metaclass_{name}", (type,), {"_TYPE_SUPPORT": support, **unused})(name, (), {})


def _lent(kind: bytes) -> int | None:
    """The address of a struct of this kind, of a type without a bound on its size."""
    meta = type(Lender)
    if meta._TYPE_SUPPORT is None:
        meta.__import_type_support__()
    whole = _TypeSupport.from_address(_pointer_in(meta._TYPE_SUPPORT, None))
    address: int | None = _HandleFor(whole.handle_for)(ctypes.addressof(whole), kind)
    return address


def _renamed(package: str, name: str, type_hash: bytes) -> object:
    serializer = _lent(_SERIALIZER)
    assert serializer is not None
    lent, describer = _TypeSupport.from_address(serializer), _lent(_DESCRIBER)

    def handle(asked: int, kind: bytes) -> int | None:
        return {_SERIALIZER: asked, _DESCRIBER: describer}.get(kind)

    callbacks = _Callbacks.from_buffer_copy(_Callbacks.from_address(lent.data))
    callbacks.message_namespace = f"{package}::msg".encode()
    callbacks.message_name = name.encode()
    own_hash = _TypeHash(1, (ctypes.c_uint8 * 32)(*type_hash))
    handle_for = _HandleFor(handle)
    get_hash = _GetHash(lambda handle: ctypes.addressof(own_hash))
    support = _TypeSupport.from_buffer_copy(lent)
    support.data = ctypes.addressof(callbacks)
    support.handle_for = ctypes.cast(handle_for, ctypes.c_void_p).value
    support.type_hash = ctypes.cast(get_hash, ctypes.c_void_p).value
    _KEPT.extend((callbacks, own_hash, handle_for, get_hash, support))
    return _capsule(ctypes.addressof(support), None, None)
