/* Faults at file calls, for LD_PRELOAD: the n-th call below a folder is killed, fails, or stalls;
   and another wall clock.

   A process maps the file $BOOTH_FAULTS/<role>: who injects writes there when and what, and reads
   how many calls there were. The role is the first word of $BOOTH_FAULT_ROLES that stands on the
   process' command line. Only calls on files below the folder named in the file are counted. */

#define _GNU_SOURCE
#include <dirent.h>
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/statvfs.h>
#include <sys/syscall.h>
#include <sys/types.h>
#include <time.h>
#include <unistd.h>

enum { NONE, KILL, FAIL, STALL, SLOW };

struct control {
    int64_t count;      /* calls so far */
    int64_t first;      /* the first one that is hit, from 1 */
    int64_t last;       /* the last one */
    int64_t action;
    int64_t value;      /* errno; milliseconds; bytes a second */
    int64_t hits;       /* calls that were hit */
    int64_t changes;    /* not 0: calls that change nothing are not counted */
    int64_t wall_s;     /* added to the wall clock */
    int64_t every;      /* calls from one that is hit to the next */
    char folder[512];
    char call[64];      /* the call that was hit last */
};

static struct control *control;

static void begin(void) {
    const char *folder = getenv("BOOTH_FAULTS"), *roles = getenv("BOOTH_FAULT_ROLES");
    if (!folder || !roles)
        return;
    char line[4096];
    int fd = syscall(SYS_openat, AT_FDCWD, "/proc/self/cmdline", O_RDONLY, 0);
    ssize_t size = syscall(SYS_read, fd, line, sizeof line - 1);
    syscall(SYS_close, fd);
    if (size <= 0)
        return;
    line[size] = 0;
    char words[512];
    snprintf(words, sizeof words, "%s", roles);
    for (char *rest, *role = strtok_r(words, " ", &rest); role; role = strtok_r(0, " ", &rest))
        for (char *word = line; word < line + size; word += strlen(word) + 1)
            if (!strcmp(word, role)) {
                char path[PATH_MAX];
                snprintf(path, sizeof path, "%s/%s", folder, role);
                fd = syscall(SYS_openat, AT_FDCWD, path, O_RDWR, 0);
                if (fd < 0)
                    return;
                void *found = mmap(0, sizeof *control, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
                syscall(SYS_close, fd);
                control = found == MAP_FAILED ? 0 : found;
                return;
            }
}

__attribute__((constructor)) static void constructed(void) { begin(); }

static int below(int at, const char *path) {
    char full[PATH_MAX * 2];
    if (path && path[0] == '/')
        return !strncmp(path, control->folder, strlen(control->folder));
    char link[64];
    if (at == AT_FDCWD)
        snprintf(link, sizeof link, "/proc/self/cwd");
    else
        snprintf(link, sizeof link, "/proc/self/fd/%d", at);
    ssize_t size = syscall(SYS_readlinkat, AT_FDCWD, link, full, sizeof full - 1);
    if (size < 0)
        return 0;
    full[size] = 0;
    return !strncmp(full, control->folder, strlen(control->folder));
}

static void pause_for(double seconds) {
    struct timespec time = {(time_t)seconds, (long)(1e9 * (seconds - (time_t)seconds))};
    nanosleep(&time, 0);
}

/* Whether the call shall fail; errno is set then. */
static int hit(const char *name, int changes, int at, const char *path, size_t bytes) {
    if (!control || !control->folder[0] || control->action == NONE)
        return 0;
    if (control->changes && !changes)
        return 0;
    int before = errno;
    int counted = below(at, path);
    errno = before;
    if (!counted)
        return 0;
    int64_t number = __atomic_add_fetch(&control->count, 1, __ATOMIC_SEQ_CST);
    if (number < control->first || number > control->last)
        return 0;
    if ((number - control->first) % control->every)
        return 0;
    __atomic_add_fetch(&control->hits, 1, __ATOMIC_SEQ_CST);
    snprintf(control->call, sizeof control->call, "%s", name);
    switch (control->action) {
    case KILL:
        syscall(SYS_kill, getpid(), SIGKILL);
        for (;;)
            pause();
    case FAIL:
        errno = (int)control->value;
        return 1;
    case STALL:
        pause_for(control->value / 1e3);
        errno = before;
        return 0;
    case SLOW:
        pause_for((double)bytes / control->value);
        errno = before;
        return 0;
    }
    return 0;
}

#define REAL(type, name, ...)                                                                      \
    static type (*real)(__VA_ARGS__);                                                              \
    if (!real)                                                                                     \
        real = dlsym(RTLD_NEXT, name)

#define OPENING (O_WRONLY | O_RDWR | O_CREAT | O_TRUNC)

#define OPEN(name)                                                                                 \
    int name(const char *path, int flags, ...) {                                                   \
        va_list more;                                                                              \
        va_start(more, flags);                                                                     \
        mode_t mode = va_arg(more, mode_t);                                                        \
        va_end(more);                                                                              \
        if (hit("open", flags & OPENING, AT_FDCWD, path, 0))                                       \
            return -1;                                                                             \
        return syscall(SYS_openat, AT_FDCWD, path, flags, mode);                                   \
    }
OPEN(open)
OPEN(open64)

#define OPENAT(name)                                                                               \
    int name(int at, const char *path, int flags, ...) {                                           \
        va_list more;                                                                              \
        va_start(more, flags);                                                                     \
        mode_t mode = va_arg(more, mode_t);                                                        \
        va_end(more);                                                                              \
        if (hit("openat", flags & OPENING, at, path, 0))                                           \
            return -1;                                                                             \
        return syscall(SYS_openat, at, path, flags, mode);                                         \
    }
OPENAT(openat)
OPENAT(openat64)

#define FOPEN(name)                                                                                \
    FILE *name(const char *path, const char *mode) {                                               \
        REAL(FILE *, #name, const char *, const char *);                                           \
        if (hit("fopen", mode[0] != 'r', AT_FDCWD, path, 0))                                       \
            return 0;                                                                              \
        return real(path, mode);                                                                   \
    }
FOPEN(fopen)
FOPEN(fopen64)

ssize_t write(int fd, const void *data, size_t size) {
    if (hit("write", 1, fd, 0, size))
        return -1;
    return syscall(SYS_write, fd, data, size);
}

ssize_t read(int fd, void *data, size_t size) {
    if (hit("read", 0, fd, 0, size))
        return -1;
    return syscall(SYS_read, fd, data, size);
}

int fsync(int fd) {
    if (hit("fsync", 1, fd, 0, 0))
        return -1;
    return syscall(SYS_fsync, fd);
}

int ftruncate64(int fd, off64_t size) {
    if (hit("ftruncate", 1, fd, 0, 0))
        return -1;
    return syscall(SYS_ftruncate, fd, size);
}

int rename(const char *from, const char *to) {
    if (hit("rename", 1, AT_FDCWD, to, 0))
        return -1;
    return syscall(SYS_renameat2, AT_FDCWD, from, AT_FDCWD, to, 0);
}

int mkdir(const char *path, mode_t mode) {
    if (hit("mkdir", 1, AT_FDCWD, path, 0))
        return -1;
    return syscall(SYS_mkdirat, AT_FDCWD, path, mode);
}

int unlink(const char *path) {
    if (hit("unlink", 1, AT_FDCWD, path, 0))
        return -1;
    return syscall(SYS_unlinkat, AT_FDCWD, path, 0);
}

int unlinkat(int at, const char *path, int flags) {
    if (hit("unlinkat", 1, at, path, 0))
        return -1;
    return syscall(SYS_unlinkat, at, path, flags);
}

int rmdir(const char *path) {
    if (hit("rmdir", 1, AT_FDCWD, path, 0))
        return -1;
    return syscall(SYS_unlinkat, AT_FDCWD, path, AT_REMOVEDIR);
}

DIR *opendir(const char *path) {
    REAL(DIR *, "opendir", const char *);
    if (hit("opendir", 0, AT_FDCWD, path, 0))
        return 0;
    return real(path);
}

/* Files' times are the kernel's: only what a process believes about today jumps. */
int clock_gettime(clockid_t clock, struct timespec *now) {
    int failed = syscall(SYS_clock_gettime, clock, now);
    if (!failed && control && clock == CLOCK_REALTIME)
        now->tv_sec += control->wall_s;
    return failed;
}

#define STAT(name, type)                                                                           \
    int name(const char *path, struct type *found) {                                               \
        REAL(int, #name, const char *, struct type *);                                             \
        if (hit("stat", 0, AT_FDCWD, path, 0))                                                     \
            return -1;                                                                             \
        return real(path, found);                                                                  \
    }
STAT(stat64, stat64)
STAT(lstat64, stat64)
STAT(statvfs64, statvfs64)

int flock(int fd, int operation) {
    if (hit("flock", 0, fd, 0, 0))
        return -1;
    return syscall(SYS_flock, fd, operation);
}
