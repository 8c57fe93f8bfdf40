/* stb_impl.c: the one place that compiles the stb image libraries. They are other people's code, so our warnings are
   off in this file. */
#if defined(__GNUC__) || defined(__clang__)
#pragma GCC diagnostic ignored "-Wall"
#pragma GCC diagnostic ignored "-Wextra"
#pragma GCC diagnostic ignored "-Wpedantic"
#pragma GCC diagnostic ignored "-Wshadow"
#pragma GCC diagnostic ignored "-Wstrict-prototypes"
#pragma GCC diagnostic ignored "-Wsign-compare"
#pragma GCC diagnostic ignored "-Wunused-function"
#pragma GCC diagnostic ignored "-Wmissing-field-initializers"
#endif

#include <stdlib.h>
#include <string.h>

/* A broken PNG can make stb_image look at memory it has not written. Zeroed memory makes that harmless: the same file
   always gives the same answer. */
static void *grow_zeroed(void *p, size_t old_size, size_t size)
{
    char *q = realloc(p, size);
    if (q && size > old_size)
        memset(q + old_size, 0, size - old_size);
    return q;
}
#define STBI_MALLOC(size) calloc(1, size)
#define STBI_REALLOC_SIZED(p, old_size, size) grow_zeroed(p, old_size, size)
#define STBI_REALLOC(p, size) realloc(p, size)
#define STBI_FREE(p) free(p)

#define STBI_MAX_DIMENSIONS 65536 /* image.c refuses more than that too */
#define STB_IMAGE_IMPLEMENTATION
#include <stb/stb_image.h>
#define STB_IMAGE_WRITE_IMPLEMENTATION
#include <stb/stb_image_write.h>
