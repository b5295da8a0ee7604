/* Makes the n-th write of a process fail, as a full or broken disk would. Preloaded into the program under test.
 *
 * FAULT_CONTROL names a file of five 64-bit numbers, shared with the test: calls so far, the first call to fail, the first not to
 * fail any more, the error, and how many calls failed. Calls are those that write to, sync or cut a file below FAULT_FOLDER, and,
 * where the processor is known here, those that give a file below it its name or make a folder. The latter are often system calls
 * of their own, past the C library, so a filter of the kernel's (seccomp) sends them to a signal handler, which makes them or not. */
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
#ifdef __x86_64__
#include <linux/audit.h>
#include <linux/filter.h>
#include <linux/seccomp.h>
#include <signal.h>
#include <stddef.h>
#include <sys/prctl.h>
#include <sys/syscall.h>
#include <ucontext.h>
#endif

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

/* Counts a call on a path; whether it is to fail. */
static int fails_at(const char *path) {
    if (!control || strncmp(path, folder, strlen(folder)) != 0) return 0;
    int64_t call = __sync_add_and_fetch(&control[0], 1);
    if (call < control[1] || call >= control[2]) return 0;
    __sync_add_and_fetch(&control[4], 1);
    errno = (int)control[3];
    return 1;
}

static int fails(int fd) {
    if (!control) return 0;
    char link[64], target[4096];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t length = readlink(link, target, sizeof target - 1);
    if (length < 0) return 0;
    target[length] = 0;
    return fails_at(target);
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

#ifdef __x86_64__
/* A system call from the one place that the filter lets through. */
long raw_call(long number, long a, long b, long c, long d, long e);
extern char after_raw_call[];
__asm__(".text\n.type raw_call, @function\nraw_call:\n"
        "mov %rdi, %rax\nmov %rsi, %rdi\nmov %rdx, %rsi\nmov %rcx, %rdx\nmov %r8, %r10\nmov %r9, %r8\n"
        "syscall\n.hidden after_raw_call\n.globl after_raw_call\nafter_raw_call:\nret\n");

/* The new name that a call gives. Names come whole: the program keeps no open folders. */
static const char *named(const greg_t *registers) {
    switch (registers[REG_RAX]) {
    case SYS_mkdir: return (const char *)registers[REG_RDI];
    case SYS_rename: case SYS_mkdirat: return (const char *)registers[REG_RSI];
    default: return (const char *)registers[REG_R10];
    }
}

static void on_call(int signal, siginfo_t *info, void *context) {
    (void)signal;
    greg_t *registers = ((ucontext_t *)context)->uc_mcontext.gregs;
    int before = errno;
    registers[REG_RAX] = info->si_syscall;
    if (fails_at(named(registers)))
        registers[REG_RAX] = -errno;
    else
        registers[REG_RAX] = raw_call(info->si_syscall, registers[REG_RDI], registers[REG_RSI], registers[REG_RDX],
                                      registers[REG_R10], registers[REG_R8]);
    errno = before;
}

__attribute__((constructor)) static void catch_names(void) {
    if (!getenv("FAULT_CONTROL")) return;
    struct sigaction action = {.sa_sigaction = on_call, .sa_flags = SA_SIGINFO | SA_NODEFER | SA_ONSTACK};
    if (sigaction(SIGSYS, &action, NULL) != 0) return;
    uint64_t after = (uint64_t)after_raw_call;
#define TRAPPED(number, left) BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, number, left, 0)
    struct sock_filter code[] = {
        BPF_STMT(BPF_LD | BPF_W | BPF_ABS, offsetof(struct seccomp_data, nr)),
        TRAPPED(SYS_rename, 6), TRAPPED(SYS_renameat, 5), TRAPPED(SYS_renameat2, 4),
        TRAPPED(SYS_linkat, 3), TRAPPED(SYS_mkdir, 2), TRAPPED(SYS_mkdirat, 1),
        BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ALLOW),
        BPF_STMT(BPF_LD | BPF_W | BPF_ABS, offsetof(struct seccomp_data, instruction_pointer)),
        BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, (uint32_t)after, 0, 3),
        BPF_STMT(BPF_LD | BPF_W | BPF_ABS, offsetof(struct seccomp_data, instruction_pointer) + 4),
        BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, (uint32_t)(after >> 32), 0, 1),
        BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ALLOW),
        BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_TRAP),
    };
    struct sock_fprog filter = {.len = sizeof code / sizeof *code, .filter = code};
    if (prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) == 0) prctl(PR_SET_SECCOMP, SECCOMP_MODE_FILTER, &filter);
}
#endif
