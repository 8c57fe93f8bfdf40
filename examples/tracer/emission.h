/* emission.h: where photon paths start, learned from those that were of use. */
#ifndef TR_EMISSION_H
#define TR_EMISSION_H

#include "tracer.h"

/* Where to start photon paths: a density over the numbers of tr_light_emit, learned from those of paths whose photons
   were of use. Memory: 1.1 MB, and 32 bytes for each of these photons until the next flush, fewer where the paths that
   were of use in the last passes are many: then only one of every 2, 4, ... of them is kept. */
tr_emission_map *tr_emission_map_create(int tiles); /* NULL = out of memory */
void tr_emission_map_destroy(tr_emission_map *map);
/* A photon of use, by its u and density; need > 0, any scale: the root of how many camera vertices meet the place where
   it came, over how many photons are known there, as the relative error falls with them. Streams as in tr_photon_fn.
   False = out of memory. */
bool tr_emission_map_record(tr_emission_map *map, int tile, const float u[5], float density, float need);
void tr_emission_map_flush(tr_emission_map *map);           /* take in what the tiles recorded */
void tr_emission_map_learn(tr_emission_map *map);           /* a pass has ended: learn from those of the last 13 */
uint64_t tr_emission_map_bytes(const tr_emission_map *map); /* held; falls at no time */
/* Variance of what photons tell with even paths, over that with these, as far as is known; 1 = it does not guide, for
   there is nothing or little to gain. */
double tr_emission_map_gain(const tr_emission_map *map);
/* Turn even numbers in [0, 1) into ones with the density, which is returned: 1/4 at least. NULL: even ones. */
float tr_emission_map_warp(const tr_emission_map *map, float u[5]);

#endif
