/* crowd.h: a parallel_for that any header takes, for the tests. After cmocka. */
#ifndef TEST_CROWD_H
#define TEST_CROWD_H

#include <pthread.h>

/* parallel_for on `threads` threads, ranges handed out in pieces of `grains` grains from the end, to mix up the order.
 */
typedef struct crowd {
    int threads;
    uint32_t grains;
} crowd;
typedef void (*crowd_fn)(void *context, uint32_t begin, uint32_t end);
typedef struct crowd_job {
    crowd_fn fn;
    void *context;
    uint32_t count, grain;
    int threads, me;
} crowd_job;

static inline void *crowd_main(void *p)
{
    crowd_job *j = p;
    uint32_t pieces = (j->count + j->grain - 1) / j->grain;
    for (uint32_t k = 0; k < pieces; ++k)
        if (k % (uint32_t)j->threads == (uint32_t)j->me) {
            uint32_t piece = pieces - 1 - k, begin = piece * j->grain;
            uint32_t end = begin + j->grain < j->count ? begin + j->grain : j->count;
            j->fn(j->context, begin, end);
        }
    return NULL;
}

static inline void crowd_for(void *user, uint32_t count, uint32_t grain, crowd_fn fn, void *context)
{
    crowd *c = user;
    pthread_t threads[8];
    crowd_job jobs[8];
    for (int i = 0; i < c->threads; ++i) {
        jobs[i] = (crowd_job){fn, context, count, (grain ? grain : 1) * c->grains, c->threads, i};
        assert_int_equal(pthread_create(&threads[i], NULL, crowd_main, &jobs[i]), 0);
    }
    for (int i = 0; i < c->threads; ++i)
        pthread_join(threads[i], NULL);
}

#endif
