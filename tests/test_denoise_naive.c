/* test_denoise_naive.c: the reference of the denoising (denoise_naive.h) against cases worked out by hand.

   gcc -std=c11 -O2 -I. tests/test_denoise_naive.c -lcmocka -lm */
#include "cmocka_prelude.h"

#include "denoise_naive.h"
#include "rng.h"

#define CLOSE(a, b) assert_true(fabs((a) - (b)) <= 1e-12 * fmax(fabs(a), fabs(b)) + 1e-300)

/* Nodes divided at random, down to `depth`, the corner at (0, 0) always; masses of leaves skewed, or their areas. */
static uint32_t grow(dn_tree *t, uint32_t halvings, uint32_t depth, bool corner, double chance, bool even)
{
    uint32_t node = t->count++;
    for (uint32_t k = 0; k < 4; ++k) {
        bool deep = corner && k == 0;
        bool divide = halvings + 1 < depth && (deep || rnd() < chance);
        t->child[4 * node + k] = divide ? grow(t, halvings + 1, depth, deep, chance, even) : 0;
        t->value[4 * node + k] = divide ? dn_mass(t, t->child[4 * node + k])
                                 : even ? pow(0.25, halvings + 1)
                                        : pow(rnd(), 4);
    }
    return node;
}

static dn_tree random_tree(uint64_t seed, uint32_t depth, double chance, bool even)
{
    dn_tree t = {0, dn_allocate(1 << 20, sizeof *t.child), dn_allocate(1 << 20, sizeof *t.value)};
    rng_state = seed;
    grow(&t, 0, depth, true, chance, even);
    assert_true(t.count < 1 << 18);
    return t;
}

static dn_matrix random_matrix(uint32_t width)
{
    dn_matrix m = dn_new_matrix(width);
    for (size_t i = 0; i < (size_t)width * width; ++i)
        m.v[i] = rnd();
    return m;
}

static void assert_equal(const dn_matrix *a, const dn_matrix *b)
{
    assert_int_equal(a->width, b->width);
    for (size_t i = 0; i < (size_t)a->width * a->width; ++i)
        CLOSE(a->v[i], b->v[i]);
}

/* ---- tree and layers */

static void test_a_leaf_after_d_halvings_is_one_element_of_layer_d(void **state)
{
    (void)state;
    uint32_t child[8] = {0, 1, 0, 0, 0, 0, 0, 0}; /* child 1: phi >= pi, z < 0 */
    float value[8] = {1, -1, 4, 8, 16, 32, 64, 128};
    dn_tree t = dn_make_tree(2, child, value);
    assert_int_equal(dn_depth(&t, 0), 2);
    assert_int_equal(dn_depth(&t, 1), 1);
    CLOSE(t.value[1], 240.0);
    CLOSE(dn_mass(&t, 0), 253.0);
    dn_matrix m = dn_flatten(&t, 2);
    static const double expected[16] = {0.25, 0.25, 16, 32, 0.25, 0.25, 64, 128, 1, 1, 2, 2, 1, 1, 2, 2};
    for (int i = 0; i < 16; ++i)
        CLOSE(m.v[i], expected[i]);
    CLOSE(dn_density(&t, 0.6, 0.1), 16.0 * 16);
    CLOSE(dn_density(&t, 0.9, 0.3), 128.0 * 16);
    CLOSE(dn_density(&t, 0.1, 0.9), 4.0 * 4);
    dn_free_matrix(&m);
    dn_free_tree(&t);
}

static void test_subtrees_are_summed_and_scaled_by_their_depth(void **state)
{
    (void)state;
    /* child 0 divided once more: d_s = 1; child 3 twice on one branch only: d_s = 2 */
    uint32_t child[16] = {1, 0, 0, 2, 0, 0, 0, 0, 0, 0, 3, 0, 0, 0, 0, 0};
    float value[16] = {0, 5, 6, 0, 1, 2, 3, 4, 10, 20, 0, 30, 1, 1, 1, 1};
    dn_tree t = dn_make_tree(4, child, value);
    assert_int_equal(dn_depth(&t, 0), 3);
    dn_matrix one = dn_flatten(&t, 1), two = dn_flatten(&t, 2), three = dn_flatten(&t, 3);
    CLOSE(one.v[0], 10.0 / 4);
    CLOSE(one.v[1], 5.0);
    CLOSE(one.v[2], 6.0);
    CLOSE(one.v[3], 64.0 / 16);
    CLOSE(two.v[0], 1.0);     /* a leaf of this layer is itself */
    CLOSE(two.v[2], 5.0 / 4); /* a leaf above is split */
    CLOSE(two.v[2 * 4 + 2], 10.0);
    CLOSE(two.v[3 * 4 + 2], 4.0 / 4);      /* a subtree below */
    CLOSE(dn_sum(&three), dn_mass(&t, 0)); /* the deepest layer has all of the mass */
    CLOSE(three.v[0], 1.0 / 4);
    CLOSE(three.v[6 * 8 + 4], 1.0);
    dn_free_matrix(&one);
    dn_free_matrix(&two);
    dn_free_matrix(&three);
    dn_free_tree(&t);
}

/* ---- blur */

static void test_weights_are_a_gaussian_with_sum_one(void **state)
{
    (void)state;
    for (double sigma = 0.3; sigma < 3; sigma += 0.3) {
        double w[7], sum = 0;
        dn_weights(sigma, w);
        for (int i = 0; i < 7; ++i) {
            sum += w[i];
            CLOSE(w[i], w[6 - i]);
            CLOSE(w[i] / w[3], exp(-(i - 3) * (i - 3) / (2 * sigma * sigma)));
        }
        CLOSE(sum, 1.0);
    }
}

static void test_an_impulse_becomes_the_window(void **state)
{
    (void)state;
    double w[7];
    dn_matrix m = dn_new_matrix(16);
    m.v[7 * 16 + 8] = 2;
    dn_weights(0.8, w);
    for (int border = DN_ZERO; border <= DN_SPHERE; ++border) {
        dn_matrix out = dn_blur(&m, 0.8, (dn_border)border, NULL);
        for (int row = 0; row < 16; ++row)
            for (int column = 0; column < 16; ++column) {
                bool inside = abs(row - 7) <= 3 && abs(column - 8) <= 3;
                CLOSE(out.v[row * 16 + column], inside ? 2 * w[row - 7 + 3] * w[column - 8 + 3] : 0.0);
            }
        dn_free_matrix(&out);
    }
    dn_free_matrix(&m);
}

static void test_an_impulse_in_a_corner_loses_mass_to_zeros(void **state)
{
    (void)state;
    double w[7];
    dn_matrix m = dn_new_matrix(16);
    m.v[0] = 1;
    dn_weights(1.1, w);
    dn_matrix out = dn_blur(&m, 1.1, DN_ZERO, NULL);
    double half = w[3] + w[4] + w[5] + w[6];
    CLOSE(dn_sum(&out), half * half);
    dn_free_matrix(&out);
    dn_free_matrix(&m);
}

static void test_an_impulse_in_a_corner_goes_around_the_sphere(void **state)
{
    (void)state;
    double w[7];
    dn_matrix m = dn_new_matrix(16);
    m.v[0] = 1;
    dn_weights(1.1, w);
    dn_matrix out = dn_blur(&m, 1.1, DN_SPHERE, NULL);
    CLOSE(dn_sum(&out), 1.0);
    CLOSE(out.v[0], w[3] * w[3]);
    CLOSE(out.v[15], w[3] * w[2]); /* across the seam of phi */
    CLOSE(out.v[2 * 16 + 13], w[5] * w[0]);
    CLOSE(out.v[8], w[2] * w[3]); /* across the pole: row 0 is row -1 of the other side */
    CLOSE(out.v[1 * 16 + 8], w[1] * w[3]);
    CLOSE(out.v[2 * 16 + 5], w[0] * w[0]);
    CLOSE(out.v[3 * 16 + 8], 0.0);
    CLOSE(out.v[15 * 16], 0.0); /* the other pole is far */
    dn_free_matrix(&out);
    m.v[0] = 0;
    m.v[15 * 16 + 9] = 1;
    out = dn_blur(&m, 1.1, DN_SPHERE, NULL);
    CLOSE(dn_sum(&out), 1.0);
    CLOSE(out.v[15 * 16 + 1], w[2] * w[3]);
    CLOSE(out.v[14 * 16 + 2], w[1] * w[2]);
    dn_free_matrix(&out);
    dn_free_matrix(&m);
}

static void test_the_sphere_keeps_mass_and_constants(void **state)
{
    (void)state;
    for (uint32_t width = 2; width <= 64; width *= 2) { /* narrower than the window too */
        dn_matrix m = random_matrix(width), out = dn_blur(&m, 1.5, DN_SPHERE, NULL);
        CLOSE(dn_sum(&out), dn_sum(&m));
        dn_free_matrix(&out);
        for (size_t i = 0; i < (size_t)width * width; ++i)
            m.v[i] = 0.7;
        out = dn_blur(&m, 1.5, DN_SPHERE, NULL);
        assert_equal(&out, &m);
        dn_free_matrix(&out);
        dn_free_matrix(&m);
    }
}

/* Rows, then columns, by the same rule for what lies outside. */
static void test_two_passes_equal_the_full_window(void **state)
{
    (void)state;
    double w[7];
    dn_weights(0.9, w);
    for (int border = DN_ZERO; border <= DN_SPHERE; ++border) {
        dn_matrix m = random_matrix(32), out = dn_blur(&m, 0.9, (dn_border)border, NULL);
        dn_matrix vertical = dn_new_matrix(32), both = dn_new_matrix(32);
        for (long row = 0; row < 32; ++row)
            for (long column = 0; column < 32; ++column)
                for (long i = -3; i <= 3; ++i) {
                    long at = dn_index(32, row + i, column, (dn_border)border);
                    vertical.v[row * 32 + column] += at < 0 ? 0 : w[i + 3] * m.v[at];
                }
        for (long row = 0; row < 32; ++row)
            for (long column = 0; column < 32; ++column)
                for (long j = -3; j <= 3; ++j) {
                    long c = column + j;
                    if (border == DN_SPHERE)
                        c &= 31;
                    both.v[row * 32 + column] += c < 0 || c > 31 ? 0 : w[j + 3] * vertical.v[row * 32 + c];
                }
        assert_equal(&both, &out);
        dn_free_matrix(&m);
        dn_free_matrix(&out);
        dn_free_matrix(&vertical);
        dn_free_matrix(&both);
    }
}

static void test_the_mask_leaves_out_windows_within_one_leaf(void **state)
{
    (void)state;
    uint32_t child[4] = {0, 0, 0, 0};
    float value[4] = {1, 2, 3, 4};
    dn_tree t = dn_make_tree(1, child, value);
    for (int border = DN_ZERO; border <= DN_SPHERE; ++border) {
        unsigned char *mask = dn_mask(&t, 4, (dn_border)border);
        for (int row = 0; row < 16; ++row)
            for (int column = 0; column < 16; ++column) {
                int r = row & 7, c = column & 7; /* leaves of 8 x 8: rows and columns 3 and 4 see no other */
                assert_int_equal(mask[row * 16 + column], !(r >= 3 && r <= 4 && c >= 3 && c <= 4));
            }
        free(mask);
    }
    dn_free_tree(&t);
}

static void test_masked_equals_unmasked(void **state)
{
    (void)state;
    for (uint64_t seed = 1; seed <= 4; ++seed)
        for (int border = DN_ZERO; border <= DN_SPHERE; ++border) {
            dn_tree t = random_tree(seed, 8, 0.25, false);
            for (uint32_t layer = 5; layer <= 8; ++layer) {
                unsigned char *mask = dn_mask(&t, layer, (dn_border)border);
                dn_matrix m = dn_flatten(&t, layer), all = dn_blur(&m, 0.8, (dn_border)border, NULL);
                dn_matrix some = dn_blur(&m, 0.8, (dn_border)border, mask);
                size_t left = 0;
                for (size_t i = 0; i < (size_t)m.width * m.width; ++i)
                    left += !mask[i];
                assert_true(layer < 8 || left > 0);
                assert_equal(&some, &all);
                dn_free_matrix(&m);
                dn_free_matrix(&all);
                dn_free_matrix(&some);
                free(mask);
            }
            dn_free_tree(&t);
        }
}

/* ---- merge and rebuild */

static void test_layers_are_expanded_by_area_and_merged_by_maximum(void **state)
{
    (void)state;
    dn_matrix small = dn_new_matrix(2), large = dn_new_matrix(8);
    small.v[0] = 16; /* 1 an element of the large one */
    small.v[3] = 48; /* 3 */
    for (int i = 0; i < 64; ++i)
        large.v[i] = 2;
    dn_expand_max(&large, &small);
    CLOSE(large.v[0], 2.0);
    CLOSE(large.v[3 * 8 + 7], 2.0);
    CLOSE(large.v[4 * 8 + 4], 3.0);
    CLOSE(large.v[63], 3.0);
    CLOSE(dn_sum(&large), 48 * 2.0 + 16 * 3.0);
    dn_free_matrix(&small);
    dn_free_matrix(&large);
}

static void test_rebuilding_divides_what_holds_more_than_rho(void **state)
{
    (void)state;
    dn_matrix m = dn_new_matrix(4);
    for (int i = 0; i < 16; ++i)
        m.v[i] = 1;
    m.v[5] = 5; /* row 1, column 1: total 20; square 0 holds 8 */
    dn_tree t = dn_rebuild(&m, 0.3, 5);
    assert_int_equal(t.count, 2);
    assert_int_equal(t.child[0], 1);
    CLOSE(t.value[0], 8.0);
    CLOSE(t.value[1], 4.0);
    CLOSE(t.value[4], 1.0);
    CLOSE(t.value[7], 5.0);
    dn_free_tree(&t);
    t = dn_rebuild(&m, 0.2, 5); /* 4 is not more than 0.2 of 20, 5 is; below the matrix mass is even: 1.25 */
    assert_int_equal(t.count, 3);
    assert_int_equal(t.child[7], 2);
    for (int k = 8; k < 12; ++k)
        CLOSE(t.value[k], 1.25);
    dn_free_tree(&t);
    t = dn_rebuild(&m, 0.2, 2);
    assert_int_equal(t.count, 2);
    dn_free_tree(&t);
    t = dn_rebuild(&m, 0.01, 3); /* everything, down to the limit */
    assert_int_equal(t.count, 1 + 4 + 16);
    assert_int_equal(dn_depth(&t, 0), 3);
    CLOSE(dn_mass(&t, 0), 20.0);
    for (uint32_t k = 0; k < 4 * t.count; ++k)
        assert_true(!t.child[k] || t.child[k] > k / 4);
    dn_free_tree(&t);
    memset(m.v, 0, 16 * sizeof *m.v);
    t = dn_rebuild(&m, 0.01, 8); /* nothing: one node */
    assert_int_equal(t.count, 1);
    CLOSE(dn_mass(&t, 0), 0.0);
    dn_free_tree(&t);
    dn_free_matrix(&m);
}

static void test_an_even_tree_stays_even(void **state)
{
    (void)state;
    dn_options o = {3, 1.2, NULL, DN_SPHERE, true, 0.01, 8};
    for (int mask = 0; mask < 2; ++mask) {
        o.mask = mask != 0;
        dn_tree t = random_tree(3, 7, 0.3, true), out = dn_denoise(&t, &o);
        CLOSE(dn_mass(&out, 0), 1.0);
        for (int i = 0; i < 1000; ++i)
            CLOSE(dn_density(&out, rnd(), rnd()), 1.0);
        dn_free_tree(&t);
        dn_free_tree(&out);
    }
}

/* The deepest layer keeps all mass, and the maximum can only add. With it alone the tree is the blurred matrix. */
static void test_no_mass_is_lost_on_the_sphere(void **state)
{
    (void)state;
    for (uint64_t seed = 1; seed <= 4; ++seed) {
        dn_tree t = random_tree(seed, 7, 0.3, false);
        dn_options o = {6, 0.8, NULL, DN_SPHERE, true, 0.002, 7};
        double mass = dn_mass(&t, 0);
        dn_tree out = dn_denoise(&t, &o);
        assert_true(dn_mass(&out, 0) >= mass * (1 - 1e-12));
        dn_free_tree(&out);
        o.first_layer = 7;
        o.rho = 0;
        out = dn_denoise(&t, &o);
        CLOSE(dn_mass(&out, 0), mass);
        dn_matrix flat = dn_flatten(&t, 7), blurred = dn_blur(&flat, 0.8, DN_SPHERE, NULL), back = dn_flatten(&out, 7);
        assert_equal(&back, &blurred);
        dn_free_matrix(&flat);
        dn_free_matrix(&blurred);
        dn_free_matrix(&back);
        dn_free_tree(&out);
        dn_free_tree(&t);
    }
}

static void test_layers_have_their_own_sigma(void **state)
{
    (void)state;
    double sigma[8] = {0, 0, 0, 0, 0, 0, 1e-3, 1e-3}; /* so narrow that nothing moves */
    dn_tree t = random_tree(5, 7, 0.3, false);
    dn_options o = {7, 2, sigma, DN_SPHERE, false, 0.01, 7};
    dn_matrix merged = dn_merge_layers(&t, &o), flat = dn_flatten(&t, 7);
    assert_equal(&merged, &flat);
    dn_free_matrix(&merged);
    dn_free_matrix(&flat);
    dn_free_tree(&t);
}

static void test_shallow_trees_are_left_as_they_are(void **state)
{
    (void)state;
    dn_options o = {6, 0.8, NULL, DN_SPHERE, true, 0.01, 16};
    dn_tree t = random_tree(2, 5, 0.4, false), out = dn_denoise(&t, &o);
    assert_int_equal(out.count, t.count);
    assert_memory_equal(out.child, t.child, 4 * t.count * sizeof *t.child);
    assert_memory_equal(out.value, t.value, 4 * t.count * sizeof *t.value);
    dn_free_tree(&t);
    dn_free_tree(&out);
}

/* ---- work limit */

static void test_work_is_the_elements_of_all_layers(void **state)
{
    (void)state;
    CLOSE(dn_work(6, 6), 4096.0);
    CLOSE(dn_work(7, 6), 20480.0);
    CLOSE(dn_work(5, 6), 0.0);
    CLOSE(dn_work(10, 6), 4096.0 * (1 + 4 + 16 + 64 + 256));
    CLOSE(dn_work_limit(0), 15000000.0);
    CLOSE(dn_work_limit(3), 120000000.0);
}

static void test_the_work_limit_admits_in_order(void **state)
{
    (void)state;
    enum { COUNT = 14 };
    uint32_t depth[COUNT] = {11, 5, 10, 10, 10, 10, 10, 10, 10, 10, 10, 10, 10, 7}; /* depth 10: 1,396,736 elements */
    bool admitted[COUNT];
    CLOSE(dn_admit(COUNT, depth, 6, 0, admitted), 10 * 1396736.0 + 20480);
    assert_false(admitted[0]); /* too deep */
    assert_false(admitted[1]); /* has no such layer */
    for (int i = 2; i < 12; ++i)
        assert_true(admitted[i]);
    assert_false(admitted[12]); /* the eleventh is over the limit */
    assert_true(admitted[13]);  /* a small one still fits */
    CLOSE(dn_admit(COUNT, depth, 6, 1, admitted), 11 * 1396736.0 + 20480);
    assert_true(admitted[12]);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_a_leaf_after_d_halvings_is_one_element_of_layer_d),
        cmocka_unit_test(test_subtrees_are_summed_and_scaled_by_their_depth),
        cmocka_unit_test(test_weights_are_a_gaussian_with_sum_one),
        cmocka_unit_test(test_an_impulse_becomes_the_window),
        cmocka_unit_test(test_an_impulse_in_a_corner_loses_mass_to_zeros),
        cmocka_unit_test(test_an_impulse_in_a_corner_goes_around_the_sphere),
        cmocka_unit_test(test_the_sphere_keeps_mass_and_constants),
        cmocka_unit_test(test_two_passes_equal_the_full_window),
        cmocka_unit_test(test_the_mask_leaves_out_windows_within_one_leaf),
        cmocka_unit_test(test_masked_equals_unmasked),
        cmocka_unit_test(test_layers_are_expanded_by_area_and_merged_by_maximum),
        cmocka_unit_test(test_rebuilding_divides_what_holds_more_than_rho),
        cmocka_unit_test(test_an_even_tree_stays_even),
        cmocka_unit_test(test_no_mass_is_lost_on_the_sphere),
        cmocka_unit_test(test_layers_have_their_own_sigma),
        cmocka_unit_test(test_shallow_trees_are_left_as_they_are),
        cmocka_unit_test(test_work_is_the_elements_of_all_layers),
        cmocka_unit_test(test_the_work_limit_admits_in_order),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
