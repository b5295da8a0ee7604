/* Makes the n-th write of a process fail, as a full or broken disk would. Preloaded into the program under test.
 *
 * FAULT_CONTROL names a file of five 64-bit numbers, shared with the test: calls so far, the first call to fail, the first not to
 * fail any more, the error, and how many calls failed. Calls are those that write to, sync or cut a file below FAULT_FOLDER. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/uio.h>
#include <unistd.h>

static volatile int64_t *control;
static char folder[4096];

__attribute__((constructor)) static void start(void) {
    const char *path = getenv("FAULT_CONTROL"), *below = getenv("FAULT_FOLDER");
    if (!path || !below || !realpath(below, folder)) return;
    int fd = open(path, O_RDWR | O_CLOEXEC);
    if (fd < 0) return;
    void *shared = mmap(NULL, 5 * sizeof(int64_t), PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
    if (shared != MAP_FAILED) control = shared;
    close(fd);
}

static int fails(int fd) {
    if (!control) return 0;
    char link[64], target[4096];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t length = readlink(link, target, sizeof target - 1);
    if (length < 0) return 0;
    target[length] = 0;
    if (strncmp(target, folder, strlen(folder)) != 0) return 0;
    int64_t call = __sync_add_and_fetch(&control[0], 1);
    if (call < control[1] || call >= control[2]) return 0;
    __sync_add_and_fetch(&control[4], 1);
    errno = (int)control[3];
    return 1;
}

#define NEXT(type, name) ((type)dlsym(RTLD_NEXT, name))

ssize_t write(int fd, const void *from, size_t size) {
    return fails(fd) ? -1 : NEXT(ssize_t (*)(int, const void *, size_t), "write")(fd, from, size);
}
ssize_t pwrite64(int fd, const void *from, size_t size, off64_t at) {
    return fails(fd) ? -1 : NEXT(ssize_t (*)(int, const void *, size_t, off64_t), "pwrite64")(fd, from, size, at);
}
ssize_t pwrite(int fd, const void *from, size_t size, off_t at) {
    return fails(fd) ? -1 : NEXT(ssize_t (*)(int, const void *, size_t, off_t), "pwrite")(fd, from, size, at);
}
ssize_t writev(int fd, const struct iovec *parts, int count) {
    return fails(fd) ? -1 : NEXT(ssize_t (*)(int, const struct iovec *, int), "writev")(fd, parts, count);
}
ssize_t copy_file_range(int in, off64_t *in_at, int out, off64_t *out_at, size_t size, unsigned flags) {
    return fails(out) ? -1
                      : NEXT(ssize_t (*)(int, off64_t *, int, off64_t *, size_t, unsigned), "copy_file_range")(
                            in, in_at, out, out_at, size, flags);
}
int fsync(int fd) { return fails(fd) ? -1 : NEXT(int (*)(int), "fsync")(fd); }
int fdatasync(int fd) { return fails(fd) ? -1 : NEXT(int (*)(int), "fdatasync")(fd); }
int ftruncate64(int fd, off64_t size) { return fails(fd) ? -1 : NEXT(int (*)(int, off64_t), "ftruncate64")(fd, size); }
