/* threads.c: see threads.h. Workers sleep between jobs, so that CPU seconds count work only. */
#define _POSIX_C_SOURCE 200809L
#include "threads.h"

#include <pthread.h>
#include <stdlib.h>
#include <time.h>
#include <unistd.h>

struct tr_pool {
    pthread_mutex_t lock;
    pthread_cond_t wake, done;
    pthread_t *threads;
    int thread_count;
    uint64_t job; /* counts up; a worker that sees a new one joins in */
    bool quit;
    int busy;
    uint32_t next, count, grain;
    tr_range_fn fn;
    void *context;
};

static double seconds(clockid_t clock)
{
    struct timespec t;
    clock_gettime(clock, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}
double tr_wall_seconds(void) { return seconds(CLOCK_MONOTONIC); }
double tr_cpu_seconds(void) { return seconds(CLOCK_PROCESS_CPUTIME_ID); }
double tr_thread_seconds(void) { return seconds(CLOCK_THREAD_CPUTIME_ID); }

int tr_cpu_count(void)
{
    long n = sysconf(_SC_NPROCESSORS_ONLN);
    return n < 1 ? 1 : n > 256 ? 256 : (int)n;
}

/* Take ranges until none is left. Called and left with the lock held. */
static void work(tr_pool *pool)
{
    while (pool->next < pool->count) {
        uint32_t begin = pool->next, left = pool->count - begin;
        uint32_t end = begin + (left < pool->grain ? left : pool->grain);
        pool->next = end;
        pthread_mutex_unlock(&pool->lock);
        pool->fn(pool->context, begin, end);
        pthread_mutex_lock(&pool->lock);
    }
}

static void *worker(void *argument)
{
    tr_pool *pool = argument;
    uint64_t seen = 0;
    pthread_mutex_lock(&pool->lock);
    for (;;) {
        while (!pool->quit && pool->job == seen)
            pthread_cond_wait(&pool->wake, &pool->lock);
        if (pool->quit)
            break;
        seen = pool->job;
        pool->busy++;
        work(pool);
        if (--pool->busy == 0)
            pthread_cond_signal(&pool->done);
    }
    pthread_mutex_unlock(&pool->lock);
    return NULL;
}

tr_pool *tr_pool_create(int threads)
{
    tr_pool *pool = calloc(1, sizeof *pool);
    if (!pool)
        return NULL;
    pthread_mutex_init(&pool->lock, NULL);
    pthread_cond_init(&pool->wake, NULL);
    pthread_cond_init(&pool->done, NULL);
    pool->threads = calloc((size_t)(threads > 1 ? threads : 1), sizeof *pool->threads);
    if (!pool->threads) {
        tr_pool_destroy(pool);
        return NULL;
    }
    for (int i = 1; i < threads; ++i) {
        if (pthread_create(&pool->threads[pool->thread_count], NULL, worker, pool) != 0)
            break; /* fewer threads than asked: slower, not wrong */
        pool->thread_count++;
    }
    return pool;
}

void tr_pool_destroy(tr_pool *pool)
{
    if (!pool)
        return;
    pthread_mutex_lock(&pool->lock);
    pool->quit = true;
    pthread_cond_broadcast(&pool->wake);
    pthread_mutex_unlock(&pool->lock);
    for (int i = 0; i < pool->thread_count; ++i)
        pthread_join(pool->threads[i], NULL);
    pthread_cond_destroy(&pool->done);
    pthread_cond_destroy(&pool->wake);
    pthread_mutex_destroy(&pool->lock);
    free(pool->threads);
    free(pool);
}

void tr_pool_run(void *user, uint32_t count, uint32_t grain, tr_range_fn fn, void *context)
{
    tr_pool *pool = user;
    if (count == 0)
        return;
    pthread_mutex_lock(&pool->lock);
    pool->next = 0;
    pool->count = count;
    pool->grain = grain ? grain : 1;
    pool->fn = fn;
    pool->context = context;
    pool->job++;
    pthread_cond_broadcast(&pool->wake);
    work(pool);
    while (pool->busy > 0)
        pthread_cond_wait(&pool->done, &pool->lock);
    pthread_mutex_unlock(&pool->lock);
}
