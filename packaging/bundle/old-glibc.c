/* Lets a program that is linked against glibc 2.31 run with 2.27: the linker sends each call of these functions here
 * (ld --wrap). Functions that only got a new version are taken in their first one. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <semaphore.h>
#include <time.h>

#if defined(__x86_64__)
#define FIRST "GLIBC_2.2.5"
#elif defined(__aarch64__)
#define FIRST "GLIBC_2.17"
#endif

#define WRAP(name, parameters, arguments) \
    double name##_first parameters; \
    __asm__(".symver " #name "_first, " #name "@" FIRST); \
    double __wrap_##name parameters { return name##_first arguments; }

WRAP(exp, (double x), (x))
WRAP(exp2, (double x), (x))
WRAP(log, (double x), (x))
WRAP(log2, (double x), (x))
WRAP(pow, (double x, double y), (x, y))

/* Wheels ask for it too: python3 exports it, and elf.py lets them take it from there. On 64 bit it is fcntl. */
int fcntl_first(int descriptor, int command, void *argument);
__asm__(".symver fcntl_first, fcntl@" FIRST);
int fcntl64(int descriptor, int command, void *argument) { return fcntl_first(descriptor, command, argument); }

/* Waiting by the monotonic clock came with 2.30. Before, the time that is left is counted on the wall clock. */
int __wrap_sem_clockwait(sem_t *semaphore, clockid_t clock, const struct timespec *until) {
    static int (*there)(sem_t *, clockid_t, const struct timespec *);
    static int asked;
    struct timespec now, wall;
    if (!asked) {
        there = (int (*)(sem_t *, clockid_t, const struct timespec *))dlsym(RTLD_DEFAULT, "sem_clockwait");
        asked = 1;
    }
    if (there)
        return there(semaphore, clock, until);
    clock_gettime(clock, &now);
    clock_gettime(CLOCK_REALTIME, &wall);
    wall.tv_sec += until->tv_sec - now.tv_sec;
    wall.tv_nsec += until->tv_nsec - now.tv_nsec;
    if (wall.tv_nsec < 0) {
        wall.tv_sec--;
        wall.tv_nsec += 1000000000;
    } else if (wall.tv_nsec >= 1000000000) {
        wall.tv_sec++;
        wall.tv_nsec -= 1000000000;
    }
    return sem_timedwait(semaphore, &wall);
}
