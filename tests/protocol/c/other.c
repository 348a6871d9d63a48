/* A program that was compiled with other options than hbp.c: 0 if that is told. */
#include "hbp.h"
static struct hbp_config c;
static struct hbp_link l;
static struct hbp h;
int main(void) { return hbp_link_init(&l, 0), hbp_add(&l, &h, &c, 1) != HBP_WRONG_OPTIONS; }
