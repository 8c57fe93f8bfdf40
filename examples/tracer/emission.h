/* emission.h: where photon paths start, learned from those that were of use. */
#ifndef TR_EMISSION_H
#define TR_EMISSION_H

#include "tracer.h"

/* Where to start photon paths: a density over the numbers of tr_light_emit, learned from those of paths whose photons
   were of use. Memory: 1 MB, and 28 bytes for each of these photons until the next flush. */
tr_emission_map *tr_emission_create(int tiles); /* NULL = out of memory */
void tr_emission_destroy(tr_emission_map *map);
/* A photon of use, by its u and density; need > 0, any scale: the inverse of how many are known where it came, as the
   relative error there falls with them. Streams as in tr_photon_fn. False = out of memory. */
bool tr_emission_record(tr_emission_map *map, int tile, const float u[5], float density, float need);
void tr_emission_flush(tr_emission_map *map); /* take in what the tiles recorded */
void tr_emission_learn(tr_emission_map *map); /* a pass has ended: learn from all so far */
/* Variance of what photons tell with even paths, over that with these, as far as is known; 1 = it does not guide, for
   there is nothing or little to gain. */
double tr_emission_gain(const tr_emission_map *map);
/* Turn even numbers in [0, 1) into ones with the density, which is returned: 1/4 at least. NULL: even ones. */
float tr_emission_warp(const tr_emission_map *map, float u[5]);

#endif
