/* Preloaded into a process: the call number FAILING_CALL, of those that reach a file in
   FAILING_PLACE, send a datagram or begin a process, fails once by FAILING_ERRNO. With FAILING_NAME
   it is of the calls of that name, by the children of the process FAILING_PARENT alone. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <poll.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <unistd.h>

static atomic_long calls;

static int is_named(const char *name)
{
    const char *only = getenv("FAILING_NAME"), *parent = getenv("FAILING_PARENT");
    return only && parent && strcmp(only, name) == 0 && atol(parent) == getppid();
}

static int fails(const char *name)
{
    if (getenv("FAILING_NAME") && !is_named(name))
        return 0;
    const char *number = getenv("FAILING_CALL"), *reason = getenv("FAILING_ERRNO");
    if (!number || atomic_fetch_add(&calls, 1) + 1 != atol(number))
        return 0;
    const char *told = getenv("FAILING_TOLD");
    int log = told ? openat(AT_FDCWD, told, O_WRONLY | O_CREAT | O_APPEND, 0600) : -1;
    if (log >= 0) {
        dprintf(log, "%d %s\n", getpid(), name);
        close(log);
    }
    errno = atoi(reason);
    return 1;
}

static int is_below(const char *path, const char *place)
{
    return place && path && strncmp(path, place, strlen(place)) == 0;
}

static int is_ours(const char *path)
{
    return is_below(path, getenv("FAILING_PLACE"));
}

static int is_open(int fd, const char *place)
{
    char link[64], path[PATH_MAX];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t n = readlink(link, path, sizeof path - 1);
    path[n > 0 ? n : 0] = 0;
    return is_below(path, place);
}

static int is_open_ours(int fd)
{
    return is_open(fd, getenv("FAILING_PLACE"));
}

#define WRAP(type, name, ours, wanted, given)                                                      \
    type name wanted                                                                               \
    {                                                                                              \
        return (ours) && fails(#name) ? (type)-1 : ((type(*) wanted)dlsym(RTLD_NEXT, #name))given; \
    }

WRAP(ssize_t, write, is_open_ours(fd), (int fd, const void *data, size_t n), (fd, data, n))
WRAP(ssize_t, read, is_open_ours(fd), (int fd, void *data, size_t n), (fd, data, n))
WRAP(int, fsync, is_open_ours(fd), (int fd), (fd))
WRAP(int, rename, is_ours(from), (const char *from, const char *to), (from, to))
WRAP(int, unlink, is_ours(path), (const char *path), (path))
WRAP(int, mkdir, is_ours(path), (const char *path, mode_t mode), (path, mode))
WRAP(ssize_t, sendto, flags != MSG_NOSIGNAL || to,
     (int fd, const void *data, size_t n, int flags, const struct sockaddr *to, socklen_t size),
     (fd, data, n, flags, to, size))
WRAP(pid_t, fork, 1, (void), ())
WRAP(int, poll, is_named("poll"), (struct pollfd *of, nfds_t n, int ms), (of, n, ms))
WRAP(int, memfd_create, is_named("memfd_create"), (const char *name, unsigned flags), (name, flags))
WRAP(ssize_t, sendmsg, is_named("sendmsg"), (int fd, const struct msghdr *msg, int flags),
     (fd, msg, flags))
WRAP(int, close, is_named("close") && is_open(fd, "/memfd:memory"), (int fd), (fd))

/* Its child would return into a frame that is gone. */
pid_t vfork(void) { return fork(); }

int open64(const char *path, int flags, ...)
{
    va_list rest;
    va_start(rest, flags);
    mode_t mode = (flags & O_CREAT) ? va_arg(rest, mode_t) : 0;
    va_end(rest);
    if (is_ours(path) && fails("open"))
        return -1;
    return ((int (*)(const char *, int, ...))dlsym(RTLD_NEXT, "open64"))(path, flags, mode);
}

int open(const char *path, int flags, ...)
{
    va_list rest;
    va_start(rest, flags);
    mode_t mode = (flags & O_CREAT) ? va_arg(rest, mode_t) : 0;
    va_end(rest);
    return open64(path, flags, mode);
}
