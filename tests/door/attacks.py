"""Programs that do a door harm, or are careless: each says that it is ready by an empty line, and
goes on until it is killed. Their arguments stand beside them.
"""

_HELLO = """
import os, select, socket, struct, sys, time

def frame(body, flags=0):
    return bytes((flags, len(body))) + body

def hello(kind):
    ready = b"\\x05READY\\x0bSocket-Type" + struct.pack(">I", len(kind)) + kind
    return b"\\xff" + bytes(8) + b"\\x7f\\x03\\x00NULL" + bytes(48) + frame(ready, 4)

def until_greeted(peer, kind):
    said = b""
    while kind not in said:
        said += peer.recv(4096) or kind

def connected(path, kind=b"SUB", other=b"XPUB"):
    peer = socket.socket(socket.AF_UNIX)
    peer.connect(path)
    peer.sendall(hello(kind))
    until_greeted(peer, other)
    return peer
"""

# Requests without end by clients that read the answers: the endpoint of control
REQUESTS = """
import sys, zmq, msgpack
context, request = zmq.Context(), msgpack.packb({"cmd": "status"})
print(flush=True)
sockets = [context.socket(zmq.DEALER) for _ in range(8)]
for socket in sockets:
    socket.connect(sys.argv[1])
while True:
    for socket in sockets:
        try:
            socket.send_multipart([b"", request], zmq.NOBLOCK)
            while socket.poll(0):
                socket.recv_multipart(zmq.NOBLOCK)
        except zmq.Again:
            pass
"""

# What is no ZeroMQ, on the robot's port: its number
NONSENSE = """
import socket, sys
listens = socket.create_server(("127.0.0.1", int(sys.argv[1])), reuse_port=False)
print(flush=True)
peer, _ = listens.accept()
peer.sendall(b"\\xff" * 200)
sys.stdin.read()
"""

# Handshakes with keys that nobody knows, without end: the server's public key, and an endpoint
STRANGE_KEYS = """
import sys, zmq
server, endpoint = sys.argv[1].encode(), sys.argv[2]
print(flush=True)
with zmq.Context() as context:
    while True:
        sockets = []
        for _ in range(20):
            socket = context.socket(zmq.SUB)
            socket.setsockopt(zmq.LINGER, 0)
            public, secret = zmq.curve_keypair()
            socket.curve_serverkey, socket.curve_publickey, socket.curve_secretkey = (
                server, public, secret)
            socket.connect(endpoint)
            sockets.append(socket)
        sockets[0].poll(50)
        for socket in sockets:
            socket.close()
"""

# Subscribers that shut their reading side, or leave, as a message comes: the stream's path
SHUT = (
    _HELLO
    + """
print(flush=True)
while True:
    try:
        with connected(sys.argv[1]) as peer:
            peer.sendall(frame(b"\\x01/taxeld/e"))
            select.select([peer], [], [], 1.0)
            peer.sendall(b"\\x00")
            peer.shutdown(socket.SHUT_RD)
            time.sleep(0.06)
    except OSError:
        time.sleep(0.01)
"""
)
