/*
 * The clock of one process, to be set while it runs.
 *
 * Preload this library (LD_PRELOAD). The file that CLOCK_OFFSET names contains the offset of
 * CLOCK_REALTIME in ns, a 64-bit integer. Waits until a time of this clock are kept.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <pthread.h>
#include <semaphore.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

#define SECOND 1000000000LL
/* Times of CLOCK_MONOTONIC, since the machine was started, are smaller. */
#define DATE 1000000000LL

static const int64_t none;
static const volatile int64_t *offset = &none;

__attribute__((constructor)) static void look_for_offset(void) {
  const char *name = getenv("CLOCK_OFFSET");
  int file = name ? open(name, O_RDONLY) : -1;
  if (file < 0) return;
  void *page = mmap(NULL, sizeof(int64_t), PROT_READ, MAP_SHARED, file, 0);
  if (page != MAP_FAILED) offset = page;
  close(file);
}

static struct timespec shifted(struct timespec time, int64_t by) {
  int64_t whole = time.tv_sec * SECOND + time.tv_nsec + by;
  struct timespec result = {whole / SECOND, whole % SECOND};
  return result;
}

/* A time until which to wait, by the clock of the kernel. */
static struct timespec until(const struct timespec *time) {
  return time->tv_sec > DATE ? shifted(*time, -*offset) : *time;
}

static void *following(const char *name) {
  /* Without a version, condition variables of before 2.3.2 would be found. */
  void *found = dlvsym(RTLD_NEXT, name, "GLIBC_2.3.2");
  return found ? found : dlsym(RTLD_NEXT, name);
}

#define FOLLOWING(name) \
  static __typeof__(name) *next; \
  if (!next) next = (__typeof__(name) *)following(#name)

int clock_gettime(clockid_t clock, struct timespec *time) {
  FOLLOWING(clock_gettime);
  int status = next(clock, time);
  if (!status && (clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE))
    *time = shifted(*time, *offset);
  return status;
}

int gettimeofday(struct timeval *restrict time, void *restrict zone) {
  struct timespec now;
  (void)zone;
  clock_gettime(CLOCK_REALTIME, &now);
  time->tv_sec = now.tv_sec;
  time->tv_usec = now.tv_nsec / 1000;
  return 0;
}

time_t time(time_t *seconds) {
  struct timespec now;
  clock_gettime(CLOCK_REALTIME, &now);
  if (seconds) *seconds = now.tv_sec;
  return now.tv_sec;
}

int pthread_cond_timedwait(
    pthread_cond_t *restrict condition, pthread_mutex_t *restrict mutex,
    const struct timespec *restrict time) {
  FOLLOWING(pthread_cond_timedwait);
  struct timespec end = until(time);
  return next(condition, mutex, &end);
}

int pthread_cond_clockwait(
    pthread_cond_t *condition, pthread_mutex_t *mutex, clockid_t clock,
    const struct timespec *time) {
  FOLLOWING(pthread_cond_clockwait);
  struct timespec end = until(time);
  return next(condition, mutex, clock, &end);
}

int pthread_mutex_timedlock(
    pthread_mutex_t *restrict mutex, const struct timespec *restrict time) {
  FOLLOWING(pthread_mutex_timedlock);
  struct timespec end = until(time);
  return next(mutex, &end);
}

int sem_timedwait(sem_t *restrict semaphore, const struct timespec *restrict time) {
  FOLLOWING(sem_timedwait);
  struct timespec end = until(time);
  return next(semaphore, &end);
}

int sem_clockwait(
    sem_t *semaphore, clockid_t clock, const struct timespec *time) {
  FOLLOWING(sem_clockwait);
  struct timespec end = until(time);
  return next(semaphore, clock, &end);
}
